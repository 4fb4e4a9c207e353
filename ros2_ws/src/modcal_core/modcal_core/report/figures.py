"""Pictures of a calibration: errors before and after, how well parameters are known, stations over time.

Charts are small and many rather than large and few, so that a page can lay them side by side or, on a phone, one below
the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import Errors
from modcal_core.effects import AXIS, JOINTS, LENGTH, RADIAL, Effect, component_names, curve
from modcal_core.geometry import Array
from modcal_core.measurements import spread_rows
from modcal_core.report.contents import ReportContents
from modcal_core.report.page import AFTER, BAD, BEFORE, GOOD, LIGHT, OF_AXES, SOFT, WARN, Chart
from modcal_core.report.plots import (
    CIRCLE,
    CROSS,
    DOT,
    SQUARE,
    TRIANGLE,
    Panel,
    chart,
    columns,
    in_decades,
    in_numbers,
    line_size,
    plot,
    with_margin,
)
from modcal_core.report.sentence import counted

MAX_POINTS = 1200  # more make the page heavy and show no more
_SETS = (("train", CIRCLE, SOFT), ("explain", SQUARE, GOOD), ("held_out", TRIANGLE, AFTER))
_MAX_REJECTED = 300


def error_histogram(report: ReportContents) -> Chart | None:
    """How often the tool misses by how much on the held-out set, before and after, on a logarithmic axis."""
    norms = {stage: 1e3 * report.errors[stage].position_norm for stage in ("final", "nominal")}
    if not len(norms["final"]):
        return None
    import lets_plot as lp

    smallest = max(min(float(np.percentile(n, 1)) for n in norms.values()), 1e-5)
    largest = max(float(n.max()) for n in norms.values())
    bins = np.geomspace(0.8 * smallest, max(1.2 * largest, 2.0 * smallest), 40)
    said = {stage: f"{stage}: {np.sqrt(np.mean(n**2)):.3f} mm RMS" for stage, n in norms.items()}
    counts = {stage: np.histogram(np.clip(n, bins[0], None), bins)[0] for stage, n in norms.items()}
    highest = max(1, *(int(count.max()) for count in counts.values()))
    step = next(s for s in (k * 10**p for p in range(9) for k in (1, 2, 5)) if highest / s <= 5.0)
    ends = with_margin(float(bins[0]), float(bins[-1]))
    drawn = plot(490, 245, "position error of held-out samples, mm", "samples", "top")
    for stage, count in counts.items():  # the nominal outlines stand over the final bars
        seen = np.flatnonzero(count)
        said_of = np.repeat(said[stage], len(seen))
        bars = {"left": bins[seen], "right": bins[seen + 1], "count": count[seen], "said": said_of}
        what = lp.aes(xmin="left", xmax="right", ymax="count", fill="said", color="said")
        drawn += lp.geom_rect(what, data=columns(bars), ymin=0, size=line_size(1.2))
    order = [said["nominal"], said["final"]]
    drawn += lp.scale_fill_manual(["rgba(0,0,0,0)", LIGHT[AFTER]], breaks=order, limits=order)
    drawn += lp.scale_color_manual([LIGHT[BEFORE], LIGHT[AFTER]], breaks=order, limits=order)
    drawn += lp.scale_x_log10(limits=list(ends), expand=[0, 0], **in_numbers(*ends))
    drawn += lp.scale_y_continuous(
        limits=[0.0, 1.05 * highest], expand=[0, 0], breaks=list(range(0, highest + 1, step))
    )
    alt = f"Histogram of held-out position errors. {'; '.join(order)}."
    words = (
        "Each bar counts held-out samples with an error of this size: outlined with the nominal model, "
        "solid with the final."
    )
    return chart(drawn, "histogram", alt, words)


def spread_chart(report: ReportContents) -> Chart | None:
    """How well each combination of parameters is known by the data alone."""
    seen = report.identifiability
    if seen is None or not seen.deviations:
        return None
    import lets_plot as lp

    deviations = np.clip(np.array(seen.deviations), 1e-9, 1e3)
    count = np.arange(1, len(deviations) + 1)
    known = np.arange(len(deviations)) < seen.rank
    ends = with_margin(min(float(deviations.min()), 0.5), max(float(deviations.max()), 2.0))
    drawn = plot(490, 213, "combination of parameters, best known first", "deviation ÷ expected")
    drawn += lp.geom_hline(yintercept=1.0, color=LIGHT[WARN], size=line_size(1.3), linetype="dashed")
    for rows, shape, colour, size in ((known, DOT, AFTER, 5.0), (~known, CROSS, BAD, 5.0)):
        if rows.any():
            at = columns({"count": count[rows], "deviation": deviations[rows]})
            drawn += lp.geom_point(
                lp.aes("count", "deviation"), data=at, shape=shape, color=LIGHT[colour], size=line_size(size)
            )
    drawn += lp.scale_y_log10(limits=list(ends), expand=[0, 0], **in_decades(*ends))
    alt = f"{seen.rank} of {seen.parameters} combinations of parameters are determined by the data."
    words = (
        "Remaining uncertainty of each combination, as a share of what was expected before measuring. "
        "Crosses, above the dashed line: not shown by these stations, held near nominal."
    )
    return chart(drawn, "spread", alt, words)


def timeline(report: ReportContents, share: float = 1.0) -> Chart | None:
    """The stations in the order of their time, what each was used for, and those that were left out.

    share: of the marks that it usually has.
    """
    samples = report.samples
    if not len(report.residuals) or not len(samples):
        return None
    import lets_plot as lp

    wrong = report.wrong if len(report.wrong) == len(samples) else np.zeros(len(samples), bool)
    miss, time = 1e3 * np.maximum(report.residuals, 1e-9), (samples.stamps - samples.stamps.min()) / 60.0
    sizes = report.set_sizes()
    marks: list[tuple[np.ndarray, str, int, str]] = []
    for name, shape, colour in _SETS:
        rows = getattr(report.sets, name)
        rows = rows[~wrong[rows]]
        rows = rows[spread_rows(len(rows), int(share * MAX_POINTS / 6.0))]
        marks.append((rows, f"{name.replace('_', '-')} ({sizes[name]})", shape, colour))
    out = report.rejected_rows()[:_MAX_REJECTED]
    marks.append((out, f"rejected ({len(out)})", CROSS, BAD))
    marks = [mark for mark in marks if len(mark[0])]
    every = np.concatenate([rows for rows, *_ in marks])
    said = np.repeat([said for _, said, *_ in marks], [len(rows) for rows, *_ in marks])
    order = [said for _, said, *_ in marks]
    ends = with_margin(float(miss[every].min()), float(miss[every].max()) * (1.0 + 1e-6))
    x, y = "time since the first sample, min", "error of the final model, mm"
    drawn = plot(788, 245, x, y, "top", time=time[every], miss=miss[every], said=said)
    what = lp.aes("time", "miss", color="said", shape="said")
    drawn += lp.geom_point(what, size=line_size(3.4), stroke=line_size(1.3))
    drawn += lp.scale_shape_manual([shape for _, _, shape, _ in marks], breaks=order, limits=order)
    drawn += lp.scale_color_manual([LIGHT[colour] for *_, colour in marks], breaks=order, limits=order)
    drawn += lp.scale_y_log10(limits=list(ends), expand=[0, 0], **in_numbers(*ends))
    over = f"{samples.stations} stations over {time.max():.1f} minutes"
    alt = f"Error of the final model at {over}; {counted(report.rejected_stations(), 'station')} rejected."
    words = "Circles fitted the model, squares chose the effects, triangles scored it; crosses were rejected."
    return chart(drawn, "timeline", alt, words)


_MAX_STEPS = 5  # that are drawn; more effects are drawn together
_MAX_TEMPERATURES = 4
_MAX_DRAWN = 14_000  # dots of a page before and after its steps, which are folded


@dataclass(frozen=True)
class Against:
    """One horizontal axis. words: for people, with the unit. values: at the scored samples, (N,)."""

    name: str
    words: str
    values: Array


@dataclass(frozen=True)
class ChartGroup:
    """Charts of what one step removed, or of the final residual. opened: shown at once."""

    title: str
    text: str
    charts: tuple[Chart, ...]
    opened: bool = False


def comparisons(report: ReportContents, share: float = 1.0) -> tuple[ChartGroup, ...]:
    """Before and after geometry, before and after each effect, and what is left at the end.

    share: of the dots that charts usually have.
    """
    if not len(report.scored):
        return ()
    along = axes_of(report)
    pairs = _pairs(report)
    most = max(min(MAX_POINTS // 3, _MAX_DRAWN // (6 * len(along) * len(pairs))), 40)
    most = max(int(share * most), 20)
    rows = spread_rows(len(report.scored), most)
    out = []
    for k, (added, before, after) in enumerate(pairs):
        sizes = f"{_rms(before):.3f} to {_rms(after):.3f} mm RMS"
        text = "Dashes: before. Dots: after. All three components of the residual, on one scale."
        charts = tuple(_before_after(a, before, after, rows, f"step{k}-{i}", added) for i, a in enumerate(along))
        out.append(ChartGroup(f"Adding {added.replace(':', ' of ')}: {sizes}", text, charts))
    final = report.errors["final"]
    rows = spread_rows(len(report.scored), max(int(share * MAX_POINTS / 3.0), 20))
    charts = tuple(_left(a, final, rows, f"left-{i}") for i, a in enumerate(along))
    text = (
        "The residual of the final model: x as circles, y as triangles, z as squares. "
        "A pattern here is an effect that the model lacks."
    )
    return (*out, ChartGroup(f"Residual: {_rms(final):.3f} mm RMS", text, charts, opened=True))


def axes_of(report: ReportContents) -> list[Against]:
    """Each joint, time since the first sample, and the recorded temperatures."""
    scored = report.scored
    units = ["rad or m"] * len(scored.names)
    if report.model is not None:
        units = ["rad" if turning else "m" for turning in report.model.chain.revolute]
    joints = [Against(n, f"{n}, {u}", q) for n, u, q in zip(scored.names, units, scored.q.T, strict=True)]
    time = Against("time", "time, min", (scored.stamps - report.samples.stamps.min()) / 60.0)
    heat = []
    if report.model is not None:
        at = report.model.drivers(scored)
        names = [name for name in at.signal_names() if name.startswith("temperature:")][:_MAX_TEMPERATURES]
        heat = [Against(name, f"temperature of {name.partition(':')[2]}, °C", at.values(name)) for name in names]
    return [*joints, time, *heat]


def _pairs(report: ReportContents) -> list[tuple[str, Errors, Errors]]:
    """What was added, and the errors before and after."""
    stages = [report.errors["nominal"], *(step.errors for step in report.steps)]
    names = [step.added for step in report.steps]
    if len(names) > _MAX_STEPS:
        rest = len(names) - _MAX_STEPS + 1
        names = [*names[: _MAX_STEPS - 1], f"{rest} more effects"]
        stages = [*stages[:_MAX_STEPS], stages[-1]]
    return [(name, stages[k], stages[k + 1]) for k, name in enumerate(names)]


def _rms(errors: Errors) -> float:
    size = errors.size_mm()
    return 0.0 if size is None else size.rms


def _before_after(a: Against, before: Errors, after: Errors, rows: np.ndarray, name: str, added: str) -> Chart:
    x = np.repeat(a.values[rows], 3)
    first, second = (1e3 * e.position[rows].ravel() for e in (before, after))
    panel = _panel(x, first)
    panel.dashes(x, first, BEFORE, 0.012, 1.1)
    panel.dashes(x, second, AFTER, 0.0, 2.2)
    alt = f"Residual against {a.name}, before and after {added}: {_rms(before):.3f} and {_rms(after):.3f} mm RMS."
    return panel.chart(name, a.words, "residual, mm", alt, f"against {a.name.replace(':', ' of ')}")


def _left(a: Against, errors: Errors, rows: np.ndarray, name: str) -> Chart:
    left = 1e3 * errors.position[rows]
    panel = _panel(a.values[rows], left.ravel())
    for k, (colour, shape) in enumerate(zip(OF_AXES, ("circle", "triangle", "square"), strict=True)):
        panel.hollow(a.values[rows], left[:, k], colour, shape)
    alt = f"Residual against {a.name}: {_rms(errors):.3f} mm RMS."
    return panel.chart(name, a.words, "residual, mm", alt, f"against {a.name.replace(':', ' of ')}")


def _panel(x: Array, y: Array) -> Panel:
    """An empty one with limits that a few far samples do not stretch."""
    reach = 1.15 * max(float(np.percentile(np.abs(y), 99.5)), 1e-6)
    low, high = float(x.min()), float(x.max())
    margin = 0.04 * max(high - low, 1e-6)
    return Panel((low - margin, high + margin), (-reach, reach))


_POINTS = 1600
_MAX_SHAPES = 24  # charts; more are looked at by nobody
_MAX_WAVES, _DRAWN_WAVES = 20, 6  # more than the first make a grey block of a small chart
_MAX_TICKS = 250  # of samples, below the curve
_UNITS = {"load": "N m", "effort": "N m", "payload": "N m per kg", "direction": "−1 or 1"}
_SHIFTS = ("x", "y", "z", LENGTH)


def effect_shapes(report: ReportContents, share: float = 1.0) -> tuple[Chart, ...]:
    """A chart for each direction of each effect that follows one number; none of what is a single number.

    share: of the charts that there are at most.
    """
    out: list[Chart] = []
    for finding in report.effects:
        drawn = tuple(e for e in finding.effects if _is_curve(e) and e.driver == finding.effects[0].driver)
        if drawn and report.model is not None:
            driver = report.model.drivers(report.samples).values(drawn[0].driver, drawn[0].lag)
            for component in range(len(component_names(drawn[0]))):
                if len(out) < share * _MAX_SHAPES:
                    out.append(_shape(report, drawn, driver, component, f"shape{len(out)}"))
    return tuple(out)


def _is_curve(effect: Effect) -> bool:
    kind = effect.driver.partition(":")[0]
    many = effect.direction in (JOINTS, RADIAL) or "," in effect.driver
    return not many and kind not in ("velocity", "reading", "constant", "moment")


def _shape(report: ReportContents, effects: tuple[Effect, ...], driver: Array, component: int, name: str) -> Chart:
    effect, direction = effects[0], component_names(effects[0])[component]
    x, size, std = curve(effects, float(driver.min()), float(driver.max()), _POINTS, component)
    at, words = driver, _words(report, effect.driver)
    if effect.driver == "time":
        begin = float(report.samples.stamps.min())
        x, at, words = (x - begin) / 60.0, (driver - begin) / 60.0, "time, min"
    slides = direction == AXIS and not _turns(report, effect.place)
    unit = "mm" if direction in _SHIFTS or slides else "mrad"
    shown = _few_waves(size)
    x, size, std = x[shown], size[shown], std[shown]
    at = at[(at >= x[0]) & (at <= x[-1])]
    low, high = (1e3 * (size + k * std) for k in (-2.0, 2.0))
    panel = Panel(_limits(float(x.min()), float(x.max())), _limits(float(low.min()), float(high.max())))
    panel.band(x, low, high, BEFORE)
    panel.line(x, 1e3 * size, AFTER, 1.1)
    panel.rug(np.sort(at)[spread_rows(len(at), _MAX_TICKS)], SOFT)
    title = f"{effect.place}, {direction}: {effect.family.replace('_', ' ')}"
    if shown != slice(None):
        title += ", a part of its range"
    alt = (
        f"{title} over {words}: {1e3 * float(size.min()):.3g} to {1e3 * float(size.max()):.3g} {unit}, with a standard "
        f"deviation of up to {1e3 * float(std.max()):.2g} {unit}."
    )
    return panel.chart(name, words, f"{direction}, {unit}", alt, title)


def _few_waves(size: Array) -> slice:
    """The points (N,) of a curve that are drawn: of many waves a few in the middle, of which each can be seen."""
    over = size > size.mean()
    turns = np.flatnonzero(over[1:] != over[:-1])
    if len(turns) <= 2 * _MAX_WAVES:
        return slice(None)
    middle = len(turns) // 2
    return slice(int(turns[middle - _DRAWN_WAVES]), int(turns[middle + _DRAWN_WAVES]) + 2)


def _limits(low: float, high: float) -> tuple[float, float]:
    """Limits of a chart axis with a small margin."""
    margin = 0.05 * max(high - low, 1e-9)
    return low - margin, high + margin


def _turns(report: ReportContents, place: str) -> bool:
    chain = report.model.chain if report.model is not None else None
    return chain is None or place not in chain.names or bool(chain.revolute[chain.names.index(place)])


def _words(report: ReportContents, driver: str) -> str:
    """A driver for people, with its unit."""
    kind, _, of = driver.partition(":")
    if kind in ("position", "following"):
        return f"{kind} of {of}, {'rad' if _turns(report, of) else 'm'}"
    if kind == "temperature":
        return f"temperature of {of}, °C"
    if kind == "signal":
        return of
    if kind in _UNITS:
        unit = _UNITS[kind] if _turns(report, of) else _UNITS[kind].replace("N m", "N")
        return f"{'load' if kind in ('effort', 'payload') else kind} of {of}, {unit}"
    return driver.replace(":", " of ")

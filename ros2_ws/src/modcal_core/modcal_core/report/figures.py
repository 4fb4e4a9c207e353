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
from modcal_core.outcome import Outcome, counted
from modcal_core.report.charts import (
    AFTER,
    BAD,
    BEFORE,
    GOOD,
    INK,
    LARGE,
    OF_AXES,
    SOFT,
    WARN,
    Axis,
    Chart,
    Panel,
)
from modcal_core.report.terminal import Account

MAX_POINTS = 1200  # more make the page heavy and show no more
_SETS = (("train", "circle", SOFT), ("explain", "square", GOOD), ("held_out", "triangle", AFTER))
_MAX_REJECTED = 300
_WIDE = 532.0  # points; of the stations over time
_MIN_DECADE = 1e-6  # of the largest row of an account; smaller ones are drawn as this
_ROW = 15.0  # points of a chart, a row


def error_histogram(report: Outcome) -> Chart | None:
    """How often the tool misses by how much on the held-out set, before and after, on a logarithmic axis."""
    norms = {stage: 1e3 * report.errors[stage].position_norm for stage in ("final", "nominal")}
    if not len(norms["final"]):
        return None
    smallest = max(min(float(np.percentile(n, 1)) for n in norms.values()), 1e-5)
    largest = max(float(n.max()) for n in norms.values())
    bins = np.geomspace(0.8 * smallest, max(1.2 * largest, 2.0 * smallest), 40)
    counts = {stage: np.histogram(np.clip(n, bins[0], None), bins)[0] for stage, n in norms.items()}
    said = [f"{stage}: {np.sqrt(np.mean(norms[stage] ** 2)):.3f} mm RMS" for stage in ("nominal", "final")]
    x = Axis.decades("position error of held-out samples, mm", float(bins[0]), float(bins[-1]))
    y = Axis("samples", 0.0, 1.05 * max(1, *(int(count.max()) for count in counts.values())), whole=True)
    panel = Panel(x, y, *LARGE, keys=((said[0], BEFORE, "square"), (said[1], AFTER, "bar")))
    for stage, colour, full in (("final", AFTER, 1.0), ("nominal", BEFORE, 0.0)):  # outlines over bars
        seen = np.flatnonzero(counts[stage])
        panel.bars((bins[seen], bins[seen + 1]), (np.zeros(len(seen)), counts[stage][seen]), colour, full)
    alt = f"Histogram of held-out position errors. {'; '.join(said)}."
    words = (
        "Each bar counts held-out samples with an error of this size: outlined with the nominal model, "
        "solid with the final."
    )
    return panel.chart("histogram", alt, words)


def spread_chart(report: Outcome) -> Chart | None:
    """How well each combination of parameters is known by the data alone."""
    seen = report.identifiability
    if seen is None or not seen.deviations:
        return None
    deviations = np.clip(np.array(seen.deviations), 1e-9, 1e3)
    count = np.arange(1.0, len(deviations) + 1.0)
    x = Axis("combination of parameters, best known first", 0.0, len(deviations) + 1.0)
    y = Axis.decades("deviation ÷ expected", min(float(deviations.min()), 0.5), max(float(deviations.max()), 2.0))
    panel = Panel(x, y, LARGE[0], 144.0)
    panel.line(np.array([x.low, x.high]), np.ones(2), WARN, 0.9, dashed=True)
    panel.marks(count[: seen.rank], deviations[: seen.rank], AFTER, "dot", 3.4)
    panel.marks(count[seen.rank :], deviations[seen.rank :], BAD, "cross", 0.9)
    alt = f"{seen.rank} of {seen.parameters} combinations of parameters are determined by the data."
    words = (
        "Remaining uncertainty of each combination, as a share of what was expected before measuring. "
        "Crosses, above the dashed line: not shown by these stations, held near nominal."
    )
    return panel.chart("spread", alt, words)


def timeline(report: Outcome, share: float = 1.0) -> Chart | None:
    """The stations in the order of their time, what each was used for, and those that were left out.

    share: of the marks that it usually has.
    """
    samples = report.samples
    if not len(report.residuals) or not len(samples):
        return None
    wrong = report.wrong if len(report.wrong) == len(samples) else np.zeros(len(samples), bool)
    miss, time = 1e3 * np.maximum(report.residuals, 1e-9), (samples.stamps - samples.stamps.min()) / 60.0
    sizes = report.set_sizes()
    marks: list[tuple[np.ndarray, str, str, str]] = []
    for name, shape, colour in _SETS:
        rows = getattr(report.sets, name)
        rows = rows[~wrong[rows]]
        rows = rows[spread_rows(len(rows), int(share * MAX_POINTS / 6.0))]
        marks.append((rows, f"{name.replace('_', '-')} ({sizes[name]})", colour, shape))
    out = report.rejected_rows()[:_MAX_REJECTED]
    marks.append((out, f"rejected ({len(out)})", BAD, "cross"))
    marks = [mark for mark in marks if len(mark[0])]
    every = np.concatenate([rows for rows, *_ in marks])
    x = Axis.around("time since the first sample, min", time)
    y = Axis.decades("error of the final model, mm", float(miss[every].min()), float(miss[every].max()) * (1.0 + 1e-6))
    panel = Panel(x, y, _WIDE, LARGE[1], keys=tuple((said, colour, shape) for _, said, colour, shape in marks))
    for rows, _, colour, shape in marks:
        panel.marks(time[rows], miss[rows], colour, shape, 0.9)
    over = f"{samples.stations} stations over {time.max():.1f} minutes"
    alt = f"Error of the final model at {over}; {counted(report.rejected_stations(), 'station')} rejected."
    words = "Circles fitted the model, squares chose the effects, triangles scored it; crosses were rejected."
    return panel.chart("timeline", alt, words)


def account_chart(account: Account) -> Chart:
    """A bar a row on a logarithmic axis, outlined where negative, with whiskers for the interval."""
    lines, unit = [line for line in account.lines if line.known], account.unit
    most = max(abs(line.value) for line in lines) or 1.0
    least = _MIN_DECADE * most
    largest = max([most, *(line.ci95[1] for line in lines if line.ci95)])
    x, y = Axis.decades(f"squared error, {unit}²", 0.5 * least, largest, 0.02), Axis.rows([one.words for one in lines])
    high = 42.0 + len(lines) * (_ROW + 8.0 * max(name.count("\n") for name in y.names))
    panel = Panel(x, y, LARGE[0] + 40.0, high)
    for k, line in enumerate(lines):
        if line.value:
            ends = (np.array([x.low]), np.array([max(abs(line.value), least)]))
            full = 0.0 if line.value < 0.0 else 1.0
            panel.bars(ends, (np.array([k - 0.31]), np.array([k + 0.31])), line.colour, full)
        if line.value > 0.0 and line.ci95 is not None:
            whiskers(panel, np.array([float(k)]), np.maximum(np.array([line.ci95]), least))
    said = "; ".join(f"{line.words} {line.value:.3g}" for line in lines)
    alt = f"Account of the squared error of the nominal model in {unit}²: {said}."
    words = (
        "Contributions to the squared error of the nominal model, on a logarithmic axis. Outlined: negative. "
        "Whiskers: 95 % interval."
    )
    return panel.chart(f"account-{unit}", alt, words)


def whiskers(panel: Panel, rows: Array, ends: Array, half: float = 0.15) -> None:
    """Intervals (N, 2) along x at these rows (N,), each with an end (half as high) that is seen."""
    panel.strokes(np.c_[ends[:, 0], rows], np.c_[ends[:, 1], rows], INK)
    for side in (0, 1):
        panel.strokes(np.c_[ends[:, side], rows - half], np.c_[ends[:, side], rows + half], INK)


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
    """Charts of what one step removed, or of the final residual."""

    title: str
    text: str
    charts: tuple[Chart, ...]


def comparisons(report: Outcome, share: float = 1.0) -> tuple[ChartGroup, ...]:
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
        charts = tuple(_before_after(a, (before, after), rows, f"step{k}-{i}", added) for i, a in enumerate(along))
        out.append(ChartGroup(f"Adding {added.replace(':', ' of ')}: {sizes}", text, charts))
    final = report.errors["final"]
    rows = spread_rows(len(report.scored), max(int(share * MAX_POINTS / 3.0), 20))
    charts = tuple(_left(a, final, rows, f"left-{i}") for i, a in enumerate(along))
    text = (
        "The residual of the final model: x as circles, y as triangles, z as squares. "
        "A pattern here is an effect that the model lacks."
    )
    return (*out, ChartGroup(f"Residual: {_rms(final):.3f} mm RMS", text, charts))


def axes_of(report: Outcome) -> list[Against]:
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


def _pairs(report: Outcome) -> list[tuple[str, Errors, Errors]]:
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


def _before_after(a: Against, errors: tuple[Errors, Errors], rows: np.ndarray, name: str, added: str) -> Chart:
    x = np.repeat(a.values[rows], 3)
    first, second = (1e3 * e.position[rows].ravel() for e in errors)
    panel = residual_panel(Axis.around(a.words, x), first)
    panel.marks(x, first, BEFORE, "dash", 1.1)
    panel.marks(x, second, AFTER, "dot", 2.2)
    before, after = map(_rms, errors)
    alt = f"Residual against {a.name}, before and after {added}: {before:.3f} and {after:.3f} mm RMS."
    return panel.chart(name, alt, f"against {a.name.replace(':', ' of ')}")


def _left(a: Against, errors: Errors, rows: np.ndarray, name: str) -> Chart:
    left = 1e3 * errors.position[rows]
    panel = residual_panel(Axis.around(a.words, a.values[rows]), left)
    mark_components(panel, a.values[rows], left)
    alt = f"Residual against {a.name}: {_rms(errors):.3f} mm RMS."
    return panel.chart(name, alt, f"against {a.name.replace(':', ' of ')}")


def residual_panel(x: Axis, y: Array) -> Panel:
    """An empty panel for residuals [mm] of any shape, whose limits a few far samples do not stretch."""
    reach = 1.15 * max(float(np.percentile(np.abs(y), 99.5)), 1e-6)
    return Panel(x, Axis("residual, mm", -reach, reach))


def mark_components(panel: Panel, x: Array, y: Array) -> None:
    """The three components of vectors (N, 3) at x (N,)."""
    for k, (colour, shape) in enumerate(OF_AXES):
        panel.marks(x, y[:, k], colour, shape)


_POINTS = 1600
_MAX_SHAPES = 24  # charts; more are looked at by nobody
_MAX_WAVES, _DRAWN_WAVES = 20, 6  # more than the first make a grey block of a small chart
_MAX_TICKS = 250  # of samples, below the curve
_UNITS = {"load": "N m", "effort": "N m", "payload": "N m per kg", "direction": "−1 or 1"}
_SHIFTS = ("x", "y", "z", LENGTH)


def effect_shapes(report: Outcome, share: float = 1.0) -> tuple[Chart, ...]:
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


def _shape(report: Outcome, effects: tuple[Effect, ...], driver: Array, component: int, name: str) -> Chart:
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
    panel = Panel(Axis.around(words, x, 0.05), Axis.around(f"{direction}, {unit}", np.r_[low, high], 0.05))
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
    return panel.chart(name, alt, title)


def _few_waves(size: Array) -> slice:
    """The points (N,) of a curve that are drawn: of many waves a few in the middle, of which each can be seen."""
    over = size > size.mean()
    turns = np.flatnonzero(over[1:] != over[:-1])
    if len(turns) <= 2 * _MAX_WAVES:
        return slice(None)
    middle = len(turns) // 2
    return slice(int(turns[middle - _DRAWN_WAVES]), int(turns[middle + _DRAWN_WAVES]) + 2)


def _turns(report: Outcome, place: str) -> bool:
    chain = report.model.chain if report.model is not None else None
    return chain is None or place not in chain.names or bool(chain.revolute[chain.names.index(place)])


def _words(report: Outcome, driver: str) -> str:
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

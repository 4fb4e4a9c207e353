"""The shape of each effect over what drives it, with its uncertainty and where the samples were."""

from __future__ import annotations

import numpy as np

from modcal_core.calibration import Model, Uncertainty, errors, without
from modcal_core.effects import AXIS, JOINTS, LENGTH, RADIAL, Effect, companionless, component_names, curve
from modcal_core.geometry import Array
from modcal_core.measurements import Samples, spread_rows
from modcal_core.report.contents import ReportContents
from modcal_core.report.diagnosis_entries import at_tool
from modcal_core.report.page import AFTER, BEFORE, SOFT, Chart
from modcal_core.report.panel import Panel

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


# --- What small curves that no report names do together: a sentence, not a cause

_MAX_SEEN = 500  # samples at which sizes at the tool are taken


def residual_notes(model: Model, known: Uncertainty, scored: Samples) -> tuple[str, ...]:
    """A sentence on the effects of the scored model that no entry contains, largest joint first; none without them.

    known: how well the model's values are known. scored: held-out samples.
    """
    numbers = companionless(model.effects)
    if not numbers or not len(scored):
        return ()
    few = scored.select(spread_rows(len(scored), _MAX_SEEN))
    of_joint: dict[str, list[int]] = {}
    for i in numbers:
        of_joint.setdefault(model.effects[i].place, []).append(i)
    size = {joint: 1e3 * at_tool(model, own, few) for joint, own in of_joint.items()}
    shares = ", ".join(f"{joint} {size[joint]:.3f} mm" for joint in sorted(size, key=lambda j: -size[j]))
    with_them, alone = (
        1e3 * float(np.sqrt(np.mean(errors(m, scored).position_norm ** 2)))
        for m in (model, without(model, known, numbers))
    )
    return (
        f"Beside what is named, small curves of joints, each held as small as these stations make likely, were learned "
        f"together (RMS at the tool: {shares}); without them the error would be {alone:.3f} instead of {with_them:.3f} "
        "mm. None of them is claimed as a cause.",
    )

"""The shape of each effect over what drives it, with its uncertainty and where the samples were."""

from __future__ import annotations

import numpy as np

from modcal_core.effects.curve import curve
from modcal_core.effects.effect import AXIS, JOINTS, LENGTH, RADIAL, Effect
from modcal_core.effects.sizes import component_names
from modcal_core.geometry.so3 import Array
from modcal_core.report.contents import ReportContents
from modcal_core.report.figures import label, small, thinned
from modcal_core.report.page import Chart, chart
from modcal_core.report.palette import LIGHT

_POINTS = 1600
_MOST_SHAPES = 24  # charts; each has some 60 kB
_MOST_TICKS = 250  # of samples, below the curve
_UNITS = {
    "position": "rad or m",
    "load": "N m",
    "effort": "N m",
    "payload": "N m per kg",
    "direction": "−1 or 1",
    "following": "rad or m",
}
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
                if len(out) < share * _MOST_SHAPES:
                    out.append(_shape(report, drawn, driver, component, f"shape{len(out)}"))
    return tuple(out)


def _is_curve(effect: Effect) -> bool:
    kind = effect.driver.partition(":")[0]
    many = effect.direction in (JOINTS, RADIAL) or "," in effect.driver
    return not many and kind not in ("velocity", "reading", "constant", "moment")


def _shape(report: ReportContents, effects: tuple[Effect, ...], driver: Array, component: int, name: str) -> Chart:
    effect, direction = effects[0], component_names(effects[0])[component]
    x, size, std = curve(effects, float(driver.min()), float(driver.max()), _POINTS, component)
    at, words = driver, _words(effect.driver)
    if effect.driver == "time":
        begin = float(report.samples.stamps.min())
        x, at, words = (x - begin) / 60.0, (driver - begin) / 60.0, "time, min"
    slides = direction == AXIS and not _turns(report, effect.place)
    unit = "mm" if direction in _SHIFTS or slides else "mrad"
    figure, axes = small(3.6, 2.0, left=0.66)
    low, high = (1e3 * (size + k * std) for k in (-2.0, 2.0))
    axes.fill_between(x, low, high, color=LIGHT["before"], alpha=0.45, lw=0)
    axes.plot(x, 1e3 * size, color=LIGHT["after"], lw=1.1)
    ticks = np.sort(at)[thinned(len(at), _MOST_TICKS)]
    axes.plot(ticks, np.full(len(ticks), axes.get_ylim()[0]), "|", ms=4.0, mew=0.5, color=LIGHT["soft"])
    label(axes, words, f"{direction}, {unit}")
    title = f"{effect.place}, {direction}: {effect.family.replace('_', ' ')}"
    alt = (
        f"{title} over {words}: {1e3 * float(size.min()):.3g} to {1e3 * float(size.max()):.3g} {unit}, with a standard "
        f"deviation of up to {1e3 * float(std.max()):.2g} {unit}."
    )
    return chart(figure, name, alt, title)


def _turns(report: ReportContents, place: str) -> bool:
    chain = report.model.chain if report.model is not None else None
    return chain is None or place not in chain.names or bool(chain.revolute[chain.names.index(place)])


def _words(driver: str) -> str:
    """A driver for people, with its unit."""
    kind, _, of = driver.partition(":")
    if kind == "temperature":
        return f"temperature of {of}, °C"
    if kind == "signal":
        return of
    if kind in _UNITS:
        return f"{'load' if kind in ('effort', 'payload') else kind} of {of}, {_UNITS[kind]}"
    return driver

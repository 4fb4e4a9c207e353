"""A robot over months: what its calibrations and checks say one after the other, and what grows.

Each quantity is a series of values with their standard deviations. A trend is the slope of a straight line through them
(weighted least squares), its error not smaller than the scatter about the line says; it is said where it is more than
chance explains at 99 % for all series together. With two values only their difference is judged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from modcal_core.calibration import Calibration
from modcal_core.effects import AXIS, Effect, curve

_TAIL = 0.01  # chance that a trend is said while there is none, over all series together
_95 = 1.959964  # standard deviations
_POINTS = 200  # of a curve
_DAY = 86400.0  # s
_SPREAD = 0.05  # of a spread of readings, its standard deviation: that of some 200 values
Values = dict[str, tuple[str, float, float, bool]]  # unit, value, standard deviation, whether it is a size; by name
_MIN = 1e-12  # a value without error would weigh more than all others


@dataclass(frozen=True)
class SeriesPoint:
    """One value [the series' unit] with its standard deviation, of one entry, at its time [s]."""

    time: float
    entry: str
    value: float
    std: float


@dataclass(frozen=True)
class Trend:
    """change: from the first to the last entry, along the line, with its 95 % interval. share: of the first value, None
    where that is no size. days: in between.
    """

    change: float
    low: float
    high: float
    share: float | None
    days: float


@dataclass(frozen=True)
class Series:
    """One quantity over time. size: whether it is a size, so that a share of it means something."""

    name: str
    unit: str
    size: bool
    points: tuple[SeriesPoint, ...]
    trend: Trend | None = None

    @property
    def sentence(self) -> str:
        """The trend, as text; empty where there is none."""
        t = self.trend
        if t is None:
            return ""
        way = "grew" if t.change > 0.0 else "fell"
        by = f"by {abs(t.change):.3g} {self.unit} ({t.low:+.3g} … {t.high:+.3g})"
        share = "" if t.share is None else f", {abs(100.0 * t.share):.0f} %"
        return f"The {self.name} {way} {by}{share} in {duration(t.days)}."


def duration(days: float) -> str:
    """So many days in the words of people."""
    if days < 60.0:
        return f"{days:.0f} days" if days >= 2.0 else f"{24.0 * days:.0f} hours"
    return f"{days / 30.44:.0f} months" if days < 730.0 else f"{days / 365.25:.1f} years"


def values_of(calibration: Calibration) -> Values:
    """(unit, value, standard deviation, whether it is a size) of each quantity of a calibration that may grow."""
    out: Values = {}
    chain = calibration.nominal.chain
    for j, name in enumerate(chain.names):
        own = [e for e in calibration.calibrated.effects if e.place == name and e.direction == AXIS]
        curves = [e for e in own if e.driver == f"position:{name}"]
        if curves:
            low, high = calibration.seen[:, j]
            rms, std = _size_of(curves, float(low), float(high))
            out[f"curve of {name}"] = ("mrad" if chain.revolute[j] else "mm", 1e3 * rms, 1e3 * std, True)
        loads = [e for e in own if e.driver == f"load:{name}" and e.shape.kind == "linear"]
        if loads:
            soft, std = sum(float(e.values[0]) for e in loads), float(np.hypot.reduce([e.std[0] for e in loads]))
            out[f"compliance of {name}"] = ("urad/(N m)", 1e6 * soft, 1e6 * std, True)
    scales = [e for e in calibration.calibrated.effects if e.place == "tracker" and e.driver == "reading"]
    if scales:
        std = float(np.hypot.reduce([e.std[0] for e in scales]))
        out["scale of the tracker"] = ("ppm", 1e6 * sum(float(e.values[0]) for e in scales), 1e6 * std, False)
    spread = 1e3 * np.sqrt(3.0) * calibration.noise.position
    if calibration.kind in ("pose", "point"):
        out["spread of the readings about the model"] = ("mm", spread, _SPREAD * spread, True)
    return out


def _size_of(curves: Sequence[Effect], low: float, high: float) -> tuple[float, float]:
    """RMS about its mean of what these curves do together from low to high, and its standard deviation."""
    x, size, _ = curve(curves, low, high, _POINTS)
    size = size - size.mean()
    rms = float(np.sqrt(np.mean(size**2)))
    by_amplitude = [e.shape.basis(x) @ size / (len(x) * max(rms, _MIN)) for e in curves]
    variance = sum(float(np.sum((g * e.std[: len(g)]) ** 2)) for g, e in zip(by_amplitude, curves, strict=True))
    return rms, float(np.sqrt(variance))


def series_of(entries: Sequence[tuple[str, float, Values]]) -> tuple[Series, ...]:
    """The series of entries (name, time [s], values by name), with trends. What stands in one entry only has none."""
    points: dict[tuple[str, str, bool], list[SeriesPoint]] = {}
    for entry, time, values in sorted(entries, key=lambda e: e[1]):
        for name, (unit, value, std, size) in values.items():
            points.setdefault((name, unit, size), []).append(SeriesPoint(time, entry, value, std))
    several = sum(of[-1].time > of[0].time for of in points.values())
    limit = -float(ndtri(0.5 * _TAIL / max(several, 1)))
    return tuple(Series(*about, tuple(of), _trend(of, about[2], limit)) for about, of in points.items())


def _trend(points: Sequence[SeriesPoint], size: bool, limit: float) -> Trend | None:
    t, y = np.array([p.time for p in points]), np.array([p.value for p in points])
    span, free = float(t[-1] - t[0]), len(points) - 2
    if span <= 0.0:
        return None
    u, std = (t - t[0]) / span, np.maximum([p.std for p in points], _MIN)
    (change, first), covariance = np.polyfit(u, y, 1, w=1.0 / std, cov="unscaled")
    left = float(np.sum(((y - first - change * u) / std) ** 2)) / free if free else 1.0
    deviation = float(np.sqrt(covariance[0, 0] * max(left, 1.0)))
    if abs(change) <= limit * deviation:
        return None
    share = float(change / first) if size and abs(first) > 0.0 else None
    return Trend(float(change), float(change - _95 * deviation), float(change + _95 * deviation), share, span / _DAY)

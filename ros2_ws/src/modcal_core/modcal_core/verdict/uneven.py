"""Scatter that is much larger in one part of a recording than in the rest: something shook, or was loose, for a while.

Nothing predicts it, for it points anywhere. Windows of stations in order of time are compared with the rest, and the
largest is compared with that of the same squares in a random order (scan statistic; Naus 1965).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import RowView, station_numbers
from modcal_core.geometry import Array
from modcal_core.measurements.kinds import is_direct
from modcal_core.verdict.case import Case, weights

_MIN = 40  # stations
_WINDOWS = (8, 12, 18, 27, 40, 60)  # stations; half as long again each
_TIMES = 6.25  # mean square in the window, in that of the rest: two and a half times in RMS, more than levers make
_SHARE = 0.25  # of all squares, that the window has beyond what as many of the rest have
_ORDERS = 400  # random ones
_FARTHEST = 5.0  # times the median size; no station may rule alone


@dataclass(frozen=True)
class Uneven:
    """Stations first to last, whose scatter is a multiple of that of the rest, RMS."""

    first: int
    last: int
    times: float

    @property
    def sentence(self) -> str:
        """The finding as a sentence."""
        return (
            f"At stations {self.first} to {self.last} readings scatter {self.times:.2g} times as much as at the "
            "others: something shook or was loose then. See what went on in the cell, and leave these stations out."
        )


def uneven(case: Case) -> Uneven | None:
    """The stations at which what a case leaves scatters far more than at the others, None where there are none."""
    rows = np.arange(len(case.wrong)) if case.fitted else case.held_out  # rejected ones too: they scatter most
    rows = rows[~case.samples.moving[rows]]
    if len(rows) < _MIN or not is_direct(case.samples.kinds):
        return None
    samples = case.samples.select(rows)
    view = RowView.of(case.model, samples, case.model.drivers(samples))
    weight = weights(case.noise, samples)
    residual = np.zeros((6, len(rows)))
    residual[:3], residual[3:, view.pose] = view.position, view.rotation
    square = np.sum((residual * weight) ** 2, axis=0)
    number = station_numbers(case.samples)[rows]
    stations, of = np.unique(number, return_inverse=True)
    mean = np.bincount(of, square) / np.bincount(of)
    mean = np.minimum(mean, _FARTHEST**2 * float(np.median(mean)))
    if len(mean) < _MIN or not mean.sum() > 0.0:
        return None
    found = _largest(mean[None])
    if found is None:
        return None
    height, first, count = float(found[0][0]), int(found[1][0]), int(found[2][0])
    inside = float(mean[first : first + count].mean())
    rest = float((mean.sum() - count * inside) / (len(mean) - count))
    if inside < _TIMES * rest or count * (inside - rest) < _SHARE * mean.sum():
        return None
    rng = np.random.default_rng(0)
    chance = _largest(rng.permuted(np.tile(mean, (_ORDERS, 1)), axis=1))
    if chance is None or float(chance[0].max()) >= height:
        return None
    return Uneven(int(stations[first]), int(stations[first + count - 1]), float(np.sqrt(inside / max(rest, 1e-300))))


def _largest(square: Array) -> tuple[Array, Array, Array] | None:
    """For each row of squares (R, S), height, first station and length of the highest window."""
    R, S = square.shape
    total = np.concatenate([np.zeros((R, 1)), np.cumsum(square, axis=1)], axis=1)
    spread = max(float(square[0].std()), 1e-300)
    best, first, count = np.full(R, -np.inf), np.zeros(R, int), np.zeros(R, int)
    for width in _WINDOWS:
        if 2 * width > S:
            break
        mean = (total[:, width:] - total[:, :-width]) / width
        height = (mean - total[:, -1:] / S) * np.sqrt(width) / spread
        at = np.argmax(height, axis=1)
        higher = height[np.arange(R), at] > best
        best = np.where(higher, height[np.arange(R), at], best)
        first, count = np.where(higher, at, first), np.where(higher, width, count)
    return (best, first, count) if count.any() else None

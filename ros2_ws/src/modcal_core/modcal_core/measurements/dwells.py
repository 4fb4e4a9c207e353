"""Dwells: when an arm stood still, and what its readings come to there; of a whole recording, and of a stream.

There is one detector. A stream asks it about the last seconds of joint states as soon as a stand has ended.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.geometry.so3 import Array

NOISE_FACTOR = 6.0  # standard deviations of encoder noise that are standstill: range of a window of noise and some room
# Median size of the second difference of Gaussian noise, in units of its deviation: 0.6745 times √(1 + 4 + 1)
SECOND_DIFFERENCE = 0.6745 * np.sqrt(6.0)
LATE_STEPS = 5.0  # usual steps between joint states, by which one may be late beyond the gap that rules allow
_OUTLYING = 8.0  # times the half-width of the closest half of a dwell's readings: far outside any noise
_ASKED = 64  # readings of a dwell that the middle is sought among


@dataclass(frozen=True)
class StationRules:
    """How stations are cut. window: [s] over which the arm must not move. still: [rad or m] that counts as no motion.
    settle: [s] after stopping that are not used. least: [s] of standing still that make a dwell, after settling.
    gap: [s] without joint states that a motion may not be interpolated over. most: samples of one instrument in motion;
    a longer recording is thinned evenly.
    """

    window: float = 0.2
    still: float = 5e-4
    settle: float = 0.25
    least: float = 0.3
    gap: float = 0.1
    most: int = 50_000


def find_dwells(t: Array, q: Array, rules: StationRules) -> Array:
    """Start and end [s] of the times the arm stood still, (d, 2), settling time already taken off.

    t: stamps, sorted, (m,). q: positions, (m, n).
    """
    if len(t) < 3:
        return np.empty((0, 2))
    step = float(np.median(np.diff(t)))
    if not 0.0 < step <= rules.window:
        return np.empty((0, 2))
    width = max(3, round(rules.window / step) | 1)
    spread = running_max(q, width) + running_max(-q, width)
    # second differences of a moving arm are small, those of encoder noise are not
    noise = np.median(np.abs(np.diff(q, 2, axis=0)), axis=0) / SECOND_DIFFERENCE
    still = (spread <= np.maximum(rules.still, NOISE_FACTOR * noise)).all(axis=1)
    still[1:] &= np.diff(t) < rules.gap + LATE_STEPS * step
    edges = np.flatnonzero(np.diff(np.r_[False, still, False].astype(int)))
    spans = np.stack([t[edges[::2]], t[edges[1::2] - 1]], axis=1)
    # the filter needs half a window on either side to have been still already
    spans[:, 0] += rules.settle - 0.5 * rules.window
    return spans[spans[:, 1] - spans[:, 0] >= rules.least]


def running_max(x: Array, width: int) -> Array:
    """The largest of each column within half a window before and after, (m, n); width is odd.

    In blocks of the window's width, of which every window meets two: the largest from a block's beginning on, and up to
    its end, are all that is needed (van Herk 1992), so that the time does not grow with the width.
    """
    blocks = -(-(len(x) + width - 1) // width)
    padded = np.full((blocks * width, x.shape[1]), -np.inf)
    padded[width // 2 : width // 2 + len(x)] = x
    cut = padded.reshape(blocks, width, -1)
    from_begin = np.maximum.accumulate(cut, axis=1).reshape(padded.shape)
    to_end = np.maximum.accumulate(cut[:, ::-1], axis=1)[:, ::-1].reshape(padded.shape)
    return np.maximum(to_end[: len(x)], from_begin[width - 1 : width - 1 + len(x)])


def inliers(position: Array) -> np.ndarray:
    """Readings of one dwell that are no glitches: within 8 robust deviations of their middle, at least half of them.

    The middle is sought about the reading that most others are near: where something was moved half way through, the
    median lies between both places, where nothing ever was.
    """
    n, least = len(position), (len(position) + 1) // 2
    some = position[np.unique(np.linspace(0, n - 1, min(n, _ASKED)).round().astype(int))]
    apart = np.sort(np.linalg.norm(some[:, None] - some[None], axis=2), axis=1)
    first = some[int(np.argmin(apart[:, (len(some) - 1) // 2]))]
    near = np.argsort(np.linalg.norm(position - first, axis=1), kind="stable")[:least]
    off = np.linalg.norm(position - np.median(position[near], axis=0), axis=1)
    limit = _OUTLYING * max(float(np.partition(off, least - 1)[least - 1]), 1e-6)
    return off <= limit


def deviation_of_mean(residual: Array, dimensions: int = 3) -> float:
    """Standard deviation per axis of the mean of residuals (k, 3), which vary along so many axes; NaN below 4 of them.

    Neighbouring readings of a tracker are correlated (filters, vibration), so the k of them count as
    ``k (1 − ρ) / (1 + ρ)`` with ρ their correlation at lag one.
    """
    k = len(residual)
    if k < 4:
        return float("nan")
    variance = float(np.sum(residual**2)) / (dimensions * (k - 1))
    if variance == 0.0:
        return 0.0
    rho = float(np.sum(residual[1:] * residual[:-1]) / np.sum(residual**2))
    effective = max(1.0, k * (1.0 - min(max(rho, 0.0), 0.99)) / (1.0 + min(max(rho, 0.0), 0.99)))
    return float(np.sqrt(variance / effective))

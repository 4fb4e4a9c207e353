"""The largest set of stations that agree on one base and one tool.

It is found by drawing a few stations at a time (RANSAC; Fischler & Bolles 1981).
"""

from __future__ import annotations

import numpy as np

from modcal_core.calibration import base_and_tool_turns, base_by_positions, consecutive, tool_and_place
from modcal_core.geometry import Array
from modcal_core.measurements import Samples
from modcal_core.plausibility.agreement import Disagreement, Placed, limits
from modcal_core.robots import Chain, forward

CLEARLY = 2.0  # times both limits; what misses by less may be the arm's own error, or that of a few stations drawn
_DRAWN = 5  # stations
_DRAWS = 240  # with a third of the stations in agreement, one draw of five is all of them, 1 − (1 − 3⁻⁵)²⁴⁰ = 63 %


def placed_by_most(samples: Samples, chain: Chain) -> tuple[Placed | None, np.ndarray]:
    """The base and the tool that most of these stations agree on, None of too few, and which of them do, (N,)."""
    return Consensus(samples, chain).largest(np.arange(len(samples)))


class Consensus:
    """Stations of one frame, in order of time, and what agrees with a base and a tool.

    A: (N, 4, 4), the flanges by the joints. poses: whether all readings are poses. limit: how far readings may miss,
    [rad] and [m]. rng: of the draws, and of what is searched for afterwards.
    """

    def __init__(self, samples: Samples, chain: Chain) -> None:
        self.samples, self.chain = samples, chain
        self.A = forward(chain, samples.q)
        self.poses = bool(samples.is_pose.all())
        self.limit = limits(chain)
        self.rng = np.random.default_rng(0)

    def within(self, placed: Placed, A: Array, samples: Samples, times: float = 1.0) -> np.ndarray:
        """Which samples, with flanges A (N, 4, 4), are within a multiple of both limits, (N,)."""
        angle, gap = placed.residual(A, samples)
        return (angle < times * self.limit[0]) & (gap < times * self.limit[1])

    def placed(self, A: Array, samples: Samples) -> Placed:
        """Base and tool from these stations."""
        return self._placed_by_each(A[None], samples.R[None], samples.reading[None])[0]

    def _placed_by_each(self, A: Array, R: Array, position: Array) -> list[Placed]:
        """Base and tool from each of C sets of stations: A (C, N, 4, 4), R (C, N, 3, 3), positions (C, N, 3)."""
        if self.poses:
            Y, X = base_and_tool_turns(A[..., :3, :3], R)
        else:
            Y = base_by_positions(A, position)
            X = np.tile(np.eye(3), (len(Y), 1, 1))
        _, x, t = tool_and_place(Y, A, position)
        return [Placed(*each) for each in zip(Y, X, x, t, strict=True)]

    def largest(self, rows: np.ndarray) -> tuple[Placed | None, np.ndarray]:
        """Base and tool that most of these stations agree on, and which of them do, (rows,)."""
        samples, A = self.samples.select(rows), self.A[rows]
        best, agree = None, np.zeros(len(rows), bool)
        drawn = _DRAWN if self.poses else _DRAWN + 3
        if len(rows) < drawn + 2:
            return best, agree
        draws = range(_DRAWS if self.poses else _DRAWS // 4)
        some = np.stack([self._drawn(len(rows), drawn, apart=bool(k % 2)) for k in draws])
        for placed in self._placed_by_each(A[some], samples.R[some], samples.reading[some]):
            inside = self.within(placed, A, samples, CLEARLY)
            if inside.sum() > agree.sum():
                best, agree = placed, inside
        for _ in range(3):
            if agree.sum() > drawn:
                best = self.placed(A[agree], samples.select(np.flatnonzero(agree)))
                agree = self.within(best, A, samples)
        return best, agree

    def _drawn(self, among: int, count: int, apart: bool) -> np.ndarray:
        """A sample of these stations: random ones, or neighbours, which agree until something changes."""
        if apart:
            return self.rng.choice(among, count, replace=False)
        first = int(self.rng.integers(max(among - 2 * count, 1)))
        return first + self.rng.choice(min(2 * count, among), count, replace=False)

    def stations(self, rows: np.ndarray) -> str:
        """These rows in words: runs of station numbers, or how many they are."""
        bad = np.zeros(len(self.samples), bool)
        bad[rows] = True
        runs = consecutive(bad)
        if len(runs) <= 3:
            number = self.samples.station
            each = [f"{number[a]} to {number[b - 1]}" for a, b in runs]
            return f"stations {' and '.join(each)}"
        return f"{len(rows)} of {len(bad)} stations, here and there"

    def said(self, rows: np.ndarray, what: str, remedy: str) -> Disagreement:
        """What is wrong with these rows."""
        return Disagreement(what, remedy, len(rows), len(self.samples))

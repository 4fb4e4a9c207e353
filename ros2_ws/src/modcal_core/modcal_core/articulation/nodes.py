"""A track of any length in few nodes: neighbours in space pooled, so that memory and work stay bounded.

A sample joins the nearest node within reach, else it founds one. When there are too many, the reach is doubled and the
nodes are pooled again. What is pooled lies within the reach, so an outlier founds a node of its own and stays apart; a
dwell, or a path that is gone over again, makes nodes surer, not more.
"""

from __future__ import annotations

import numpy as np

from modcal_core.articulation.track import Track
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array

_LENGTH = 0.1  # m: a turn of 1 rad is as far as this shift
_FIRST_REACH = 4e-3  # m
FEWEST_NODES = 6  # while more are coming: a circle in space has six parameters


class Nodes:
    """At most ``most`` pooled samples, in the order of their first sample."""

    def __init__(self, oriented: bool, most: int = 32, reach: float = _FIRST_REACH) -> None:
        self.oriented, self.most, self.reach = oriented, most, reach
        self._width = 12 if oriented else 3
        self._rotations = np.zeros((most, 3, 3))
        self._stale = np.ones(most, dtype=bool)  # whose rotation is older than their sum
        self._sums = np.zeros((most, self._width))
        self.counts = np.zeros(most)
        self.k = 0

    def add(self, position: Array, rotation: Array | None, weight: float = 1.0) -> bool:
        """Pool one sample; whether there were too many nodes, so that all were pooled again, which takes its time."""
        row = np.empty(self._width)
        row[:3] = position
        if self.oriented:
            assert rotation is not None
            row[3:] = rotation.ravel() * (_LENGTH / np.sqrt(2.0))
        return self._pool(row * weight, weight)

    def _pool(self, row: Array, weight: float) -> bool:
        if self.k:
            apart = self.means() - row / weight
            squared = (apart * apart).sum(axis=1)
            nearest = int(squared.argmin())
            if squared[nearest] <= self.reach**2:
                self._sums[nearest] += row
                self.counts[nearest] += weight
                self._stale[nearest] = True
                return False
        if self.k == self.most:
            self._coarsen()
            self._pool(row, weight)
            return True
        self._sums[self.k], self.counts[self.k], self._stale[self.k] = row, weight, True
        self.k += 1
        return False

    def _coarsen(self) -> None:
        rows, counts, k = self._sums[: self.k].copy(), self.counts[: self.k].copy(), self.k
        while True:
            self.reach *= 1.2
            self.k = 0
            self.counts[:] = 0.0
            for i in range(k):
                self._pool(rows[i], float(counts[i]))
            if self.k <= 0.75 * self.most:
                return

    def means(self) -> Array:
        """Means (k, 3), or (k, 12) with the rotation's matrix scaled to a length [m]."""
        return self._sums[: self.k] / self.counts[: self.k, None]

    def apart(self) -> Array:
        """Distances (k, k) [m] between nodes, turns counted as the shift of a hand's length."""
        m = self.means()
        squares = (m * m).sum(axis=1)
        return np.sqrt(np.maximum(squares[:, None] + squares[None] - 2.0 * m @ m.T, 0.0))

    def track(self, fewest: int = FEWEST_NODES) -> Track | None:
        """The nodes as a track; None where they are fewer than that."""
        if self.k < fewest:
            return None
        m = self.means()
        if not self.oriented:
            return Track.trusted(m)
        stale = self._stale[: self.k].nonzero()[0]
        self._rotations[stale] = so3.nearest_rotation(m[stale, 3:].reshape(-1, 3, 3))
        self._stale[stale] = False
        return Track.trusted(m[:, :3], self._rotations[: self.k].copy())

"""A path as the means of short stretches, bounded: when there are too many, neighbours are pooled."""

from __future__ import annotations

import math

import numpy as np

from modcal_core.geometry.so3 import Array

MAX = 64  # stretches: of a metre some 2 cm each
_STRETCH = 4e-3  # m, at first; less would be play
_NOISE = 4.0  # deviations of noise on an axis that a stretch is long, where that is more


class Stretches:
    """path: how far it goes [m]. k: how many there are."""

    def __init__(self) -> None:
        self.path, self.k = 0.0, 0
        self._sums, self._counts, self._ways = np.zeros((MAX, 3)), np.zeros(MAX), np.zeros(MAX)
        self._length = _STRETCH
        self._begin: Array | None = None  # of the stretch that is under way

    def come(self, p: Array, noise: float) -> None:
        """Take a position (3,) [m]. noise: of one position, on an axis [m]."""
        if self._begin is None:
            self._begin, self.k = p, 1
        far = math.dist(p, self._begin)
        if far >= max(self._length, _NOISE * noise):
            self._begin = p
            self.path += far
            if self.k == MAX:
                self._pool()
            self._ways[self.k] = self.path
            self.k += 1
        self._sums[self.k - 1] += p
        self._counts[self.k - 1] += 1.0

    def _pool(self) -> None:
        """Neighbours together."""
        half = MAX // 2
        for each in (self._sums, self._counts):
            each[:half] = each[0::2] + each[1::2]
            each[half:] = 0.0
        self._ways[:half] = self._ways[0::2]
        self.k, self._length = half, 2.0 * self._length

    @property
    def counts(self) -> Array:
        """How many positions are in each (k,)."""
        return self._counts[: self.k]

    @property
    def points(self) -> Array:
        """Their means (k, 3) [m]."""
        return self._sums[: self.k] / self.counts[:, None]

    def beyond(self, way: float) -> Array:
        """Means (m, 3) of those that begin after so much of the path [m]."""
        first = int(np.searchsorted(self._ways[: self.k], way, side="left"))
        return self._sums[first : self.k] / self._counts[first : self.k, None]

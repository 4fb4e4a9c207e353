"""Sums of columns times waves of an angle: ``Σ f_n exp(i k s q_n)`` for k from 0 to thousands.

Directly, N angles and K waves take 4 N K operations a column. By an FFT some 10 N + 20 K log K: the angles are
irregular, so each column is first spread over a regular grid by a kernel a few points wide, and what the kernel does to
each frequency is divided out again (non-uniform FFT of type 1, with the kernel of Barnett, Magland & af Klinteberg,
SIAM J. Sci. Comput. 2019); it agrees to 1e-8 of the sum of the |f_n|.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property, lru_cache

import numpy as np
import scipy

from modcal_core.geometry import Array

_WIDTH = 10  # points of the grid that an angle is spread over: one decimal each, less one
_FINER = 2.0  # how much finer the grid is than the highest wave needs
_STEEP = 3.067 * _WIDTH  # of the kernel, times what a grid so fine leaves of it (the paper's 0.976 π)
_NODES = 40  # of the quadrature for the kernel's transform
_AT_ONCE = 64  # columns, whose grids then stay near the processor
Key = tuple[int, object]  # a place, and a direction there or what else moves


class Spectrum:
    """Waves of N angles, at multiples of a step."""

    def __init__(self, angle: Array, step: float, most: int) -> None:
        """angle: (N,) [rad]. step: cycles a turn between neighbouring waves. most: the number of the highest wave."""
        self._angle, self._step, self.most = angle, step, most
        self._weight: tuple[Array, tuple[Array, Array]] | None = (
            None  # that products were asked with last, and its sums
        )

    def sums(self, columns: Array) -> Array:
        """Sums with the sine and the cosine of each wave, (most + 1, 2, m), of columns (N, m)."""
        out = np.empty((self.most + 1, 2, columns.shape[1]))
        for some, waves in self._grid.waves(columns):
            out[:, 0, some], out[:, 1, some] = -waves.imag, waves.real
        return out

    def gram(self, which: np.ndarray, weight: Array) -> Array:
        """Products with each other, (C, 2 w, 2 w), of sine and cosine of w waves, (C, w) numbers, times a weight (N,).

        A product of two waves is a wave of their sum and one of their difference.
        """
        if self._weight is None or not np.array_equal(weight, self._weight[0]):  # of waves and of double ones the same
            ((_, waves),) = _Grid(self._angle, self._step, 2 * self.most).waves(weight[:, None])
            self._weight = weight, (-waves[:, 0].imag, waves[:, 0].real)
        sine, cosine = self._weight[1]
        C, w = which.shape
        out = np.empty((C, 2 * w, 2 * w))
        for a in range(w):
            for b in range(w):
                more, less = which[:, a] + which[:, b], np.abs(which[:, a] - which[:, b])
                turned = np.sign(which[:, a] - which[:, b]) * sine[less]
                out[:, 2 * a, 2 * b] = 0.5 * (cosine[less] - cosine[more])
                out[:, 2 * a + 1, 2 * b + 1] = 0.5 * (cosine[less] + cosine[more])
                out[:, 2 * a, 2 * b + 1] = 0.5 * (sine[more] + turned)
                out[:, 2 * a + 1, 2 * b] = 0.5 * (sine[more] - turned)
        return out

    @cached_property
    def _grid(self) -> _Grid:
        return _Grid(self._angle, self._step, self.most)


class _Grid:
    """A regular grid that columns are spread over, for waves of multiples of a step up to the number ``most``."""

    def __init__(self, angle: Array, step: float, most: int) -> None:
        points = int(scipy.fft.next_fast_len(int(2.0 * _FINER * most) + 2 * _WIDTH, real=True))
        at = np.mod(step * angle, 2.0 * np.pi) * (points / (2.0 * np.pi))
        near = np.ceil(at - 0.5 * _WIDTH)[:, None] + np.arange(_WIDTH)
        value, where = _kernel((near - at[:, None]) * (2.0 / _WIDTH)), near.astype(np.int64) % points
        begins = np.arange(0, value.size + 1, _WIDTH)
        spread = scipy.sparse.csr_array((value.ravel(), where.ravel(), begins), shape=(len(value), points))
        self._spread, self._share, self._most = spread.T.tocsr(), _shares(points, most)[:, None], most

    def waves(self, columns: Array) -> Iterator[tuple[slice, np.ndarray]]:
        """Sums of some columns (N, m) at a time with exp(−i k s q), (most + 1, some)."""
        for first in range(0, columns.shape[1], _AT_ONCE):
            some = slice(first, first + _AT_ONCE)
            grid: Array = np.asarray(self._spread @ np.ascontiguousarray(columns[:, some]), dtype=float)
            yield some, scipy.fft.rfft(grid, axis=0, overwrite_x=True)[: self._most + 1] * self._share


def _kernel(z: Array) -> Array:
    steep = _STEEP * (1.0 - 0.5 / _FINER)
    return np.asarray(np.exp(steep * (np.sqrt(np.maximum(1.0 - z * z, 0.0)) - 1.0)))


@lru_cache(maxsize=64)
def _shares(points: int, most: int) -> Array:
    """What each wave of a grid is to be multiplied by, (most + 1,)."""
    z, weight = np.polynomial.legendre.leggauss(_NODES)
    phase = np.arange(most + 1)[:, None] * (z * (np.pi * _WIDTH / points))
    return np.asarray(2.0 / _WIDTH / (np.cos(phase) @ (_kernel(z) * weight)))


def squared(sums: Array) -> Array:
    """``sums sumsᵀ`` of each candidate, (C, m, m), pair by pair: a product of small matrices for each is slower."""
    C, m, _ = sums.shape
    out = np.empty((C, m, m))
    for a in range(m):
        for b in range(a + 1):
            out[:, a, b] = out[:, b, a] = np.einsum("ck,ck->c", sums[:, a], sums[:, b])
    return out

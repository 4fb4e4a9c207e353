"""Sums of many columns times waves of an angle: ``Σ f_n exp(i k s q_n)`` for k from 0 to thousands, by an FFT each.

The angles are irregular, so each column is first spread over a regular grid by a kernel a few points wide, and what the
kernel does to each frequency is divided out again (non-uniform FFT of type 1, with the kernel of Barnett, Magland & af
Klinteberg, SIAM J. Sci. Comput. 2019). Directly, N angles and K waves take 4 N K operations a column; this takes some
10 N + 20 K log K, and agrees to 1e-8 of the sum of the |f_n|.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import fft, sparse

from modcal_core.geometry.so3 import Array

_WIDTH = 10  # points of the grid that an angle is spread over: one decimal each, less one
_STEEP = 2.30 * _WIDTH  # of the kernel, for a grid twice as fine as the highest wave needs
_NODES = 40  # of the quadrature for the kernel's transform
_AT_ONCE = 64  # columns, whose grids then stay near the processor


class Spectrum:
    """Waves of N angles, at multiples of a step."""

    def __init__(self, angle: Array, step: float, most: int) -> None:
        """angle: (N,) [rad]. step: cycles a turn between neighbouring waves. most: the number of the highest wave."""
        self.most = most
        points = fft.next_fast_len(4 * most + 2 * _WIDTH, real=True)
        at = np.mod(step * angle, 2.0 * np.pi) * (points / (2.0 * np.pi))
        near = np.ceil(at - 0.5 * _WIDTH)[:, None] + np.arange(_WIDTH)
        value = _kernel((near - at[:, None]) * (2.0 / _WIDTH))
        where = near.astype(np.int64) % points
        begins = np.arange(0, value.size + 1, _WIDTH)
        shape = len(angle), points
        self._spread = sparse.csr_array((value.ravel(), where.ravel(), begins), shape=shape).T.tocsr()
        self._share = _shares(points, most)

    def sums(self, columns: Array) -> Array:
        """Complex sums (most + 1, m) of columns (N, m) times each wave."""
        out = np.empty((self.most + 1, columns.shape[1]), complex)
        for first in range(0, columns.shape[1], _AT_ONCE):
            some = slice(first, first + _AT_ONCE)
            grid = np.asarray(self._spread @ np.ascontiguousarray(columns[:, some]), dtype=float)
            np.conj(fft.rfft(grid, axis=0, overwrite_x=True)[: self.most + 1], out=out[:, some])
        out *= self._share[:, None]
        return out


def _kernel(z: Array) -> Array:
    return np.asarray(np.exp(_STEEP * (np.sqrt(np.maximum(1.0 - z * z, 0.0)) - 1.0)))


@lru_cache(maxsize=64)
def _shares(points: int, most: int) -> Array:
    """What each wave of a grid is to be multiplied by, (most + 1,)."""
    z, weight = np.polynomial.legendre.leggauss(_NODES)
    phase = np.arange(most + 1)[:, None] * (z * (np.pi * _WIDTH / points))
    return np.asarray(2.0 / _WIDTH / (np.cos(phase) @ (_kernel(z) * weight)))

"""Sums of many columns times waves of an angle: ``Σ f_n exp(i k s q_n)`` for k from 0 to thousands, by an FFT each.

The angles are irregular, so each column is first spread over a regular grid by a kernel a few points wide, and what the
kernel does to each frequency is divided out again (non-uniform FFT of type 1, with the kernel of Barnett, Magland & af
Klinteberg, SIAM J. Sci. Comput. 2019). Directly, N angles and K waves take 4 N K operations a column; this takes some
10 N + 20 K log K, and agrees to 1e-8 of the sum of the |f_n|.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy import fft, sparse

from modcal_core.geometry.so3 import Array

_WIDTH = 10  # points of the grid that an angle is spread over: one decimal each, less one
_STEEP = 2.30 * _WIDTH  # of the kernel, for a grid twice as fine as the highest wave needs
_NODES = 40  # of the quadrature for the kernel's transform
_AT_ONCE = 64  # columns, whose grids then stay near the processor


@dataclass(frozen=True)
class SquaredSums:
    """Products of sums with many columns, summed over the columns, for every wave.

    sine, cosine: of a wave's sums with themselves, (K + 1,). both: of the one with the other. doubled: of sine and
    cosine (first index) with sine and cosine (second) of the wave of twice the number, (2, 2, K // 2 + 1).
    """

    sine: Array
    cosine: Array
    both: Array
    doubled: Array


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
        for some, waves in self._portions(columns):
            np.conj(waves, out=out[:, some])
        out *= self._share[:, None]
        return out

    def squares(self, columns: Array) -> SquaredSums:
        """Products of the sums with columns (N, m), summed over these; without keeping a sum."""
        own, doubled = np.zeros((3, self.most + 1)), np.zeros((4, self.most // 2 + 1))
        for _, waves in self._portions(columns):
            sine, cosine = waves.imag, waves.real
            for out, one, other in zip(own, (sine, cosine, sine), (sine, cosine, cosine), strict=True):
                out += np.einsum("km,km->k", one, other)
            few = slice(self.most // 2 + 1)
            pairs = [(one[few], other[::2]) for one in (sine, cosine) for other in (sine, cosine)]
            for out, (one, other) in zip(doubled, pairs, strict=True):
                out += np.einsum("km,km->k", one, other)
        share = self._share
        own *= share**2
        doubled *= share[: doubled.shape[1]] * share[::2]
        own[2] *= -1.0  # the transform turns the other way
        doubled[1:3] *= -1.0
        return SquaredSums(own[0], own[1], own[2], doubled.reshape(2, 2, -1))

    def _portions(self, columns: Array) -> Iterator[tuple[slice, Array]]:
        """Transforms (most + 1, some) of some columns at a time, which turn the other way."""
        single = columns.dtype == np.float32
        spread = self._lean if single else self._spread
        for first in range(0, columns.shape[1], _AT_ONCE):
            some = slice(first, first + _AT_ONCE)
            grid = np.asarray(spread @ np.ascontiguousarray(columns[:, some]))
            yield some, fft.rfft(grid, axis=0, overwrite_x=True)[: self.most + 1]

    @cached_property
    def _lean(self) -> sparse.csr_array:
        return self._spread.astype(np.float32)


def _kernel(z: Array) -> Array:
    return np.asarray(np.exp(_STEEP * (np.sqrt(np.maximum(1.0 - z * z, 0.0)) - 1.0)))


@lru_cache(maxsize=64)
def _shares(points: int, most: int) -> Array:
    """What each wave of a grid is to be multiplied by, (most + 1,)."""
    z, weight = np.polynomial.legendre.leggauss(_NODES)
    phase = np.arange(most + 1)[:, None] * (z * (np.pi * _WIDTH / points))
    return np.asarray(2.0 / _WIDTH / (np.cos(phase) @ (_kernel(z) * weight)))

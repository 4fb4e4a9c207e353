"""Sums of many columns times waves of an angle: ``Σ f_n exp(i k s q_n)`` for k from 0 to thousands.

Of few angles the waves are a table, and the sums one product of matrices: N angles and K waves take 4 N K operations a
column. Of many an FFT takes less. The angles are irregular, so each column is first spread over a regular grid by a
kernel a few points wide, and what the kernel does to each frequency is divided out again (non-uniform FFT of type 1,
with the kernel of Barnett, Magland & af Klinteberg, SIAM J. Sci. Comput. 2019). This takes some 10 N + 20 K log K, and
agrees to 1e-8 of the sum of the |f_n|.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import scipy

from modcal_core.effects.shapes import periodic
from modcal_core.geometry.so3 import Array

_FEW = 400  # angles up to which a table is quicker: half of the time of an FFT with 300, as much with 500 to 700
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


class Spectrum(ABC):
    """Waves of N angles, at multiples of a step."""

    def __init__(self, step: float, most: int) -> None:
        """step: cycles a turn between neighbouring waves. most: the number of the highest wave."""
        self.step, self.most = step, most

    @staticmethod
    def of(angle: Array, step: float, most: int) -> Spectrum:
        """Those of angles (N,) [rad], by the quicker way."""
        return _Table(angle, step, most) if len(angle) <= _FEW else _Transform(angle, step, most)

    @abstractmethod
    def sums(self, columns: Array) -> Array:
        """Sums with the sine and the cosine of each wave, (most + 1, 2, m), of columns (N, m)."""

    @abstractmethod
    def squares(self, columns: Array) -> SquaredSums:
        """Products of the sums with columns (N, m), summed over these; without keeping a sum."""

    @abstractmethod
    def gram(self, which: np.ndarray, square: Array) -> Array:
        """Products with each other, (C, 2 w, 2 w), of sine and cosine of w waves, (C, w) numbers, times a weight (N,)
        of the samples.
        """


class _Table(Spectrum):
    """Few angles: the waves themselves, (most + 1, 2, N)."""

    def __init__(self, angle: Array, step: float, most: int) -> None:
        super().__init__(step, most)
        self._waves = periodic("turn", step * np.arange(most + 1, dtype=float), angle)

    def sums(self, columns: Array) -> Array:
        waves = self._lean if columns.dtype == np.float32 else self._waves
        flat = waves.reshape(-1, waves.shape[2]) @ columns
        return np.asarray(flat.reshape(self.most + 1, 2, -1))

    def squares(self, columns: Array) -> SquaredSums:
        squares = _Squares(self.most)
        for first in range(0, columns.shape[1], _AT_ONCE):
            sums = self.sums(columns[:, first : first + _AT_ONCE])
            squares.add(sums[:, 0], sums[:, 1])
        return squares.all(np.ones(self.most + 1))

    def gram(self, which: np.ndarray, square: Array) -> Array:
        waves = self._waves[which].reshape(len(which), 2 * which.shape[1], -1)
        return np.asarray((waves * square) @ waves.transpose(0, 2, 1))

    @cached_property
    def _lean(self) -> np.ndarray:
        return self._waves.astype(np.float32)


class _Transform(Spectrum):
    """Many angles: by an FFT."""

    def __init__(self, angle: Array, step: float, most: int) -> None:
        super().__init__(step, most)
        self._angle = angle
        points = scipy.fft.next_fast_len(4 * most + 2 * _WIDTH, real=True)
        at = np.mod(step * angle, 2.0 * np.pi) * (points / (2.0 * np.pi))
        near = np.ceil(at - 0.5 * _WIDTH)[:, None] + np.arange(_WIDTH)
        value = _kernel((near - at[:, None]) * (2.0 / _WIDTH))
        where = near.astype(np.int64) % points
        begins = np.arange(0, value.size + 1, _WIDTH)
        shape = len(angle), points
        self._spread = scipy.sparse.csr_array((value.ravel(), where.ravel(), begins), shape=shape).T.tocsr()
        self._share = _shares(points, most)

    def sums(self, columns: Array) -> Array:
        out = np.empty((self.most + 1, 2, columns.shape[1]))
        for some, waves in self._portions(columns):
            np.multiply(waves.imag, -self._share[:, None], out=out[:, 0, some])  # the transform turns the other way
            np.multiply(waves.real, self._share[:, None], out=out[:, 1, some])
        return out

    def squares(self, columns: Array) -> SquaredSums:
        squares = _Squares(self.most)
        for _, waves in self._portions(columns):
            squares.add(waves.imag, waves.real)
        return squares.all(self._share, turned=-1.0)

    def gram(self, which: np.ndarray, square: Array) -> Array:
        # a product of two waves is a wave of their sum and one of their difference
        sine, cosine = self._doubled.sums(square[:, None])[:, :, 0].T
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

    def _portions(self, columns: Array) -> Iterator[tuple[slice, Array]]:
        """Transforms (most + 1, some) of some columns at a time, which turn the other way."""
        single = columns.dtype == np.float32
        spread = self._lean if single else self._spread
        for first in range(0, columns.shape[1], _AT_ONCE):
            some = slice(first, first + _AT_ONCE)
            grid = np.asarray(spread @ np.ascontiguousarray(columns[:, some]))
            yield some, scipy.fft.rfft(grid, axis=0, overwrite_x=True)[: self.most + 1]

    @cached_property
    def _lean(self) -> scipy.sparse.csr_array:
        return self._spread.astype(np.float32)

    @cached_property
    def _doubled(self) -> Spectrum:
        """One up to twice the highest wave."""
        return _Transform(self._angle, self.step, 2 * self.most)


class _Squares:
    """Products of sums, some columns at a time."""

    def __init__(self, most: int) -> None:
        self._own, self._doubled = np.zeros((3, most + 1)), np.zeros((4, most // 2 + 1))

    def add(self, sine: Array, cosine: Array) -> None:
        """Those of some columns, (most + 1, some)."""
        for out, one, other in zip(self._own, (sine, cosine, sine), (sine, cosine, cosine), strict=True):
            out += np.einsum("km,km->k", one, other)
        few = slice(self._doubled.shape[1])
        pairs = [(one[few], other[::2]) for one in (sine, cosine) for other in (sine, cosine)]
        for out, (one, other) in zip(self._doubled, pairs, strict=True):
            out += np.einsum("km,km->k", one, other)

    def all(self, share: Array, turned: float = 1.0) -> SquaredSums:
        """The products, each sum times a share (most + 1,). turned: −1 where the sines had the other sign."""
        own, doubled = self._own * share**2, self._doubled * (share[: self._doubled.shape[1]] * share[::2])
        own[2] *= turned
        doubled[1:3] *= turned
        return SquaredSums(own[0], own[1], own[2], doubled.reshape(2, 2, -1))


def _kernel(z: Array) -> Array:
    return np.asarray(np.exp(_STEEP * (np.sqrt(np.maximum(1.0 - z * z, 0.0)) - 1.0)))


@lru_cache(maxsize=64)
def _shares(points: int, most: int) -> Array:
    """What each wave of a grid is to be multiplied by, (most + 1,)."""
    z, weight = np.polynomial.legendre.leggauss(_NODES)
    phase = np.arange(most + 1)[:, None] * (z * (np.pi * _WIDTH / points))
    return np.asarray(2.0 / _WIDTH / (np.cos(phase) @ (_kernel(z) * weight)))

"""Sums of columns times waves of an angle: ``Σ f_n exp(i k s q_n)`` for k from 0 to thousands.

Directly, N angles and K waves take 4 N K operations a column. By an FFT some 10 N + 20 K log K: the angles are
irregular, so each column is first spread over a regular grid by a kernel a few points wide, and what the kernel does to
each frequency is divided out again (non-uniform FFT of type 1, with the kernel of Barnett, Magland & af Klinteberg,
SIAM J. Sci. Comput. 2019); it agrees to 1e-8 of the sum of the |f_n|, and in single precision, on a coarser grid, to
1e-6. Where angles are few and columns many, a table of
the waves is quicker still, for a product of matrices goes through it once for all columns.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Protocol

import numpy as np
import scipy

from modcal_core.effects import periodic
from modcal_core.geometry import Array

_FEW = 400  # angles up to which a table is quicker: half of the time of an FFT with 300, as much with 500 to 700
_SINGLE = 12  # columns; of fewer, each for itself by an FFT takes less than to read the table
_WIDTH = 10  # points of the grid that an angle is spread over: one decimal each, less one
# How much finer the grid is than the highest wave needs: in single precision a coarser one loses no more than that does
_FINER, _LEAN_FINER = 2.0, 1.25
_STEEP = 3.067 * _WIDTH  # of the kernel, times what a grid so fine leaves of it (the paper's 0.976 π)
_NODES = 40  # of the quadrature for the kernel's transform
_AT_ONCE = 64  # columns, whose grids then stay near the processor
Key = tuple[int, object]  # a place, and a direction there or what else moves


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
        self._angle, self._step, self.most = angle, step, most
        self._weight: tuple[Array, tuple[Array, Array]] | None = (
            None  # that products were asked with last, and its sums
        )

    def sums(self, columns: Array) -> Array:
        """Sums with the sine and the cosine of each wave, (most + 1, 2, m), of columns (N, m)."""
        if self._has_table(columns):
            return self._by_table(columns)
        out = np.empty((self.most + 1, 2, columns.shape[1]))
        if columns.shape[1] < _SINGLE:
            for i, column in enumerate(columns.T):
                out[:, 0, i], out[:, 1, i] = self._grid.sums(column, self.most)
            return out
        share = self._grid_of(columns).share[:, None]
        for some, waves in self._portions(columns):
            np.multiply(waves.imag, -share, out=out[:, 0, some])  # the transform turns the other way
            np.multiply(waves.real, share, out=out[:, 1, some])
        return out

    def squares(self, columns: Array) -> SquaredSums:
        """Products of the sums with columns (N, m), summed over these; without keeping a sum."""
        squares = _Squares(self.most)
        if columns.shape[1] >= _SINGLE and not self._has_table(columns):
            for _, waves in self._portions(columns):
                squares.add(waves.imag, waves.real)
            return squares.all(self._grid_of(columns).share, turned=-1.0)
        for first in range(0, columns.shape[1], _AT_ONCE):
            sums = self.sums(columns[:, first : first + _AT_ONCE])
            squares.add(sums[:, 0], sums[:, 1])
        return squares.all(np.ones(self.most + 1))

    def gram(self, which: np.ndarray, weight: Array) -> Array:
        """Products with each other, (C, 2 w, 2 w), of sine and cosine of w waves, (C, w) numbers, times a weight (N,).

        A product of two waves is a wave of their sum and one of their difference.
        """
        if self._weight is None or not np.array_equal(weight, self._weight[0]):  # of waves and of double ones the same
            self._weight = weight, self._wide_grid.sums(weight, 2 * self.most)
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

    def _has_table(self, columns: Array) -> bool:
        """Whether a table serves these columns."""
        return len(self._angle) <= _FEW and columns.shape[1] >= _SINGLE

    def _by_table(self, columns: Array) -> Array:
        waves = self._lean_table if columns.dtype == np.float32 else self._table
        return np.asarray((waves.reshape(-1, waves.shape[2]) @ columns).reshape(self.most + 1, 2, -1))

    @cached_property
    def _table(self) -> Array:
        """The waves themselves, (most + 1, 2, N)."""
        return periodic("turn", self._step * np.arange(self.most + 1, dtype=float), self._angle)

    @cached_property
    def _lean_table(self) -> np.ndarray:
        return self._table.astype(np.float32)

    @cached_property
    def _grid(self) -> _Grid:
        return _Grid(self._angle, self._step, self.most)

    @cached_property
    def _wide_grid(self) -> _Grid:
        """Grid for waves of twice as many cycles."""
        return _Grid(self._angle, self._step, 2 * self.most)

    @cached_property
    def _lean_grid(self) -> _Grid:
        return _Grid(self._angle, self._step, self.most, _LEAN_FINER)

    def _grid_of(self, columns: Array) -> _Grid:
        """The grid that columns of this precision are spread over."""
        return self._lean_grid if columns.dtype == np.float32 else self._grid

    def _portions(self, columns: Array) -> Iterator[tuple[slice, Array]]:
        """Transforms (most + 1, some) of some columns at a time, which turn the other way."""
        grid_of = self._grid_of(columns)
        spread = grid_of.lean if columns.dtype == np.float32 else grid_of.spread
        for first in range(0, columns.shape[1], _AT_ONCE):
            some = slice(first, first + _AT_ONCE)
            grid = np.asarray(spread @ np.ascontiguousarray(columns[:, some]))
            yield some, scipy.fft.rfft(grid, axis=0, overwrite_x=True)[: self.most + 1]


class _Grid:
    """A regular grid that columns are spread over. share: what each wave is to be multiplied by, (most + 1,)."""

    def __init__(self, angle: Array, step: float, most: int, finer: float = _FINER) -> None:
        self.points = _fast_length(int(2.0 * finer * most) + 2 * _WIDTH)
        at = np.mod(step * angle, 2.0 * np.pi) * (self.points / (2.0 * np.pi))
        near = np.ceil(at - 0.5 * _WIDTH)[:, None] + np.arange(_WIDTH)
        self._value = _kernel((near - at[:, None]) * (2.0 / _WIDTH), finer)
        self._where = near.astype(np.int64) % self.points
        self.share = _shares(self.points, most, finer)

    def sums(self, column: Array, most: int) -> tuple[Array, Array]:
        """Sums of one column (N,) with the sine and the cosine of each wave, (most + 1,) each."""
        spread = np.bincount(self._where.ravel(), (self._value * column[:, None]).ravel(), self.points)
        waves = np.fft.rfft(spread)[: most + 1] * self.share
        return -waves.imag, waves.real

    @cached_property
    def spread(self) -> scipy.sparse.csr_array:
        """Matrix (points, N) that spreads columns (N, m) onto the grid."""
        begins = np.arange(0, self._value.size + 1, _WIDTH)
        shape = len(self._value), self.points
        return scipy.sparse.csr_array((self._value.ravel(), self._where.ravel(), begins), shape=shape).T.tocsr()

    @cached_property
    def lean(self) -> scipy.sparse.csr_array:
        """The same in single precision."""
        return self.spread.astype(np.float32)


class _Squares:
    """Products of sums, some columns at a time."""

    def __init__(self, most: int) -> None:
        self._own, self._doubled = np.zeros((3, most + 1)), np.zeros((4, most // 2 + 1))

    def add(self, sine: Array, cosine: Array) -> None:
        """Add the squares of columns (most + 1, some)."""
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


def _fast_length(least: int) -> int:
    """The least number of points from there on that has no other factors than 2, 3 and 5, and is even."""
    best = 1 << (least - 1).bit_length()
    for odd in (3, 5, 9, 15, 25, 27, 45, 75):
        power = 1 << max((-(-least // odd) - 1).bit_length(), 1)
        best = min(best, odd * power)
    return best


def _kernel(z: Array, finer: float) -> Array:
    steep = _STEEP * (1.0 - 0.5 / finer)
    return np.asarray(np.exp(steep * (np.sqrt(np.maximum(1.0 - z * z, 0.0)) - 1.0)))


@lru_cache(maxsize=64)
def _shares(points: int, most: int, finer: float) -> Array:
    """What each wave of a grid is to be multiplied by, (most + 1,)."""
    z, weight = np.polynomial.legendre.leggauss(_NODES)
    phase = np.arange(most + 1)[:, None] * (z * (np.pi * _WIDTH / points))
    return np.asarray(2.0 / _WIDTH / (np.cos(phase) @ (_kernel(z, finer) * weight)))


class NumbersOfKeys(Protocol):
    """What has numbers of its own for each of several keys."""

    def times(self, of: Mapping[Key, Array]) -> Array:
        """All numbers times the matrices (N, k) of their keys, (R, k)."""
        ...


class KnownSums:
    """Sums that were computed already: banks share them. Of one scan, whose matrices stay as long."""

    def __init__(self) -> None:
        self._waves: dict[tuple[int, int], Array] = {}
        self._squares: dict[tuple[int, int], SquaredSums] = {}
        self._running: dict[tuple[int, int], Array] = {}
        self._numbers: dict[int, Array] = {}
        self._kept: list[object] = []  # what sums are of, so that nothing else takes its number

    def waves(self, spectrum: Spectrum, columns: Array) -> Array:
        """Sums of columns (N, k) with the waves of a spectrum, (K + 1, 2, k)."""
        key = id(spectrum), id(columns)
        if key not in self._waves:
            self._waves[key] = spectrum.sums(columns)
            self._kept.append(columns)
        return self._waves[key]

    def squares(self, spectrum: Spectrum, columns: Array) -> SquaredSums:
        """Products of the sums with columns (N, k), summed over these."""
        key = id(spectrum), id(columns)
        if key not in self._squares:
            self._squares[key] = spectrum.squares(columns)
            self._kept.append(columns)
        return self._squares[key]

    def running(self, parts: Parts, matrix: Array) -> Array:
        """Sums of the rows of a matrix (N, k) before each of some times and of all, (parts + 1, k)."""
        key = id(parts), id(matrix)
        if key not in self._running:
            self._running[key] = parts.running(matrix)
            self._kept += [parts, matrix]
        return self._running[key]

    def numbers(self, pool: NumbersOfKeys, of: Mapping[Key, Array]) -> Array:
        """All numbers of a pool times the matrices (N, k) of their keys, (R, k)."""
        if id(pool) not in self._numbers:
            self._numbers[id(pool)] = pool.times(of)
            self._kept.append(pool)
        return self._numbers[id(pool)]


class Parts:
    """Samples in parts, one after the other along an order."""

    def __init__(self, order: np.ndarray, edges: np.ndarray) -> None:
        """order: of the samples, (N,). edges: how many are before each part, each number once, the first 0."""
        self._count = len(edges)
        parts = np.ones(len(order)), order, np.append(edges, len(order))
        self._of_each = scipy.sparse.csr_array(parts, shape=(len(edges), len(order)))  # each sample once, in its part

    @cached_property
    def _lean(self) -> scipy.sparse.csr_array:
        return self._of_each.astype(np.float32)

    def running(self, matrix: Array) -> Array:
        """Sums of the rows of a matrix (N, k) before each part and of all, (parts + 1, k)."""
        of_each = self._lean if matrix.dtype == np.float32 else self._of_each
        running = np.zeros((self._count + 1, matrix.shape[1]))
        np.cumsum(of_each @ matrix, axis=0, dtype=float, out=running[1:])
        return running


def squared(sums: Array) -> Array:
    """``sums sumsᵀ`` of each candidate, (C, m, m): without a product of small matrices for each where m is small."""
    if sums.shape[1] == 1:
        return np.asarray(np.einsum("cmk,cmk->c", sums, sums)[:, None, None])
    return np.asarray(sums @ sums.transpose(0, 2, 1))

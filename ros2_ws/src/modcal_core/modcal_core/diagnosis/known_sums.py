"""Sums over the samples that banks of candidates share within one scan, each computed once."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy

from modcal_core.diagnosis.spectra import Spectrum, SquaredSums
from modcal_core.geometry import Array

Key = tuple[int, object]  # a place, and a direction there or what else moves


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

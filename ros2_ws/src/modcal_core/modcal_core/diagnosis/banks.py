"""Candidates in banks: those that stand at the same places and directions are contracted with anything at once.

Every candidate is a direction at a place times numbers, one a sample. What is asked of a bank are sums over the samples
of its numbers times something: times the residual under the signs of each trial, times the projector, and, for the
products of its columns with each other, times their squares. Three kinds of numbers need three ways to sum:

* waves of a joint's angle, nine in ten of all candidates: an FFT (:mod:`spectra`);
* what begins or ends at some time: running sums in the order of time;
* all others: products of matrices.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from modcal_core.diagnosis.spectra import Spectrum, SquaredSums
from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import Effect
from modcal_core.geometry.so3 import Array

Key = tuple[int, object]
ALL = slice(None)
LEAST_WAVES = 32  # below that an FFT costs more than it saves
_SAME = 1e-9  # of a step


class Bank(Protocol):
    """C candidates of m columns each. keys: place and direction of each of the m."""

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The candidates, (C,)."""
        ...

    @property
    def keys(self) -> tuple[Key, ...]:
        """Place and direction of each column, (m,)."""
        ...

    def sums(self, of: Sequence[Array], spectra: Spectra, rows: slice = ALL) -> Array:
        """Numbers of some candidates times one matrix (N, k) for each of the m columns, (C, m, k)."""
        ...

    def gram(self, columns: Sequence[Array]) -> Array:
        """Products of each candidate's columns with each other (C, m, m). columns: unit columns (6, N) of each key."""
        ...

    def gram_of_sums(self, of: Sequence[Array], spectra: Spectra) -> Array:
        """Products with each other, (C, m, m), of the sums with the columns of the matrices (N, k)."""
        ...


class Spectra:
    """Spectra and running sums that were computed already: banks of one driver share them. Of one scan."""

    def __init__(self) -> None:
        self._known: dict[tuple[int, int], tuple[Array, Array]] = {}
        self._squares: dict[tuple[int, int], tuple[Array, SquaredSums]] = {}
        self._running: dict[tuple[int, bytes, int], tuple[np.ndarray, Array, Array]] = {}

    def of(self, spectrum: Spectrum, columns: Array) -> Array:
        """Sums of columns (N, k) times the waves of a spectrum, (K + 1, k)."""
        key = id(spectrum), id(columns)
        if key not in self._known:
            self._known[key] = columns, spectrum.sums(columns)  # kept, so that no other takes its number
        return self._known[key][1]

    def squares_of(self, spectrum: Spectrum, columns: Array) -> SquaredSums:
        """Products of the sums with columns (N, k), summed over these."""
        key = id(spectrum), id(columns)
        if key not in self._squares:
            self._squares[key] = columns, spectrum.squares(columns)
        return self._squares[key][1]

    def running(self, order: np.ndarray, edges: np.ndarray, matrix: Array) -> Array:
        """Sums of the rows of a matrix (N, k), taken in this order, before each edge and of all, (edges + 1, k)."""
        key = id(order), edges.tobytes(), id(matrix)
        if key not in self._running:
            self._running[key] = order, matrix, running_sums(order, edges, matrix)
        return self._running[key][2]


@dataclass(frozen=True)
class NumberBank:
    """Candidates of any numbers, (C, m, N)."""

    effects: tuple[Effect, ...]
    keys: tuple[Key, ...]
    numbers: Array

    def sums(self, of: Sequence[Array], spectra: Spectra, rows: slice = ALL) -> Array:
        """See :class:`Bank`."""
        numbers = (self._lean if of[0].dtype == np.float32 else self.numbers)[rows]
        C, m, N = numbers.shape
        groups = self._groups()
        if len(groups) == 1:
            return np.asarray((numbers.reshape(-1, N) @ of[0]).reshape(C, m, -1))
        out = np.empty((C, m, of[0].shape[1]))
        for some in groups:
            out[:, some] = (numbers[:, some].reshape(-1, N) @ of[some[0]]).reshape(C, len(some), -1)
        return out

    @cached_property
    def _lean(self) -> np.ndarray:
        return self.numbers.astype(np.float32)

    def _groups(self) -> list[list[int]]:
        """The columns of each key."""
        return [[a for a, key in enumerate(self.keys) if key == one] for one in dict.fromkeys(self.keys)]

    def gram_of_sums(self, of: Sequence[Array], spectra: Spectra) -> Array:
        """See :class:`Bank`."""
        return _squared(self.sums(of, spectra))

    def gram(self, columns: Sequence[Array]) -> Array:
        """See :class:`Bank`."""
        C, m, _ = self.numbers.shape
        if m == 1:
            return np.asarray((self.numbers[:, 0] ** 2 @ np.sum(columns[0] ** 2, axis=0))[:, None, None])
        groups = self._groups()
        if len(groups) == 1:
            square = np.sum(columns[0] ** 2, axis=0)
            return np.asarray((self.numbers * square) @ self.numbers.transpose(0, 2, 1))
        out = np.empty((C, m, m))
        for i, some in enumerate(groups):
            for others in groups[i:]:
                both = np.sum(columns[some[0]] * columns[others[0]], axis=0)
                product = (self.numbers[:, some] * both) @ self.numbers[:, others].transpose(0, 2, 1)
                for k, a in enumerate(some):
                    out[:, a, others], out[:, others, a] = product[:, k], product[:, k]
        return out


@dataclass(frozen=True)
class WaveBank:
    """Sines and cosines along one driver, m/2 of either a candidate: of one wave, or of one and that of twice as many
    cycles. which: their numbers in the spectrum, (C, m/2).

    squares: the spectrum up to twice the highest of them.
    """

    effects: tuple[Effect, ...]
    keys: tuple[Key, ...]
    which: np.ndarray
    spectrum: Spectrum
    squares: Spectrum

    def sums(self, of: Sequence[Array], spectra: Spectra, rows: slice = ALL) -> Array:
        """See :class:`Bank`."""
        waves = spectra.of(self.spectrum, of[0])[self.which[rows]]  # (C, m/2, k)
        out = np.empty((len(waves), 2 * waves.shape[1], waves.shape[2]))
        out[:, 0::2], out[:, 1::2] = waves.imag, waves.real
        return out

    def gram(self, columns: Sequence[Array]) -> Array:
        """See :class:`Bank`. A product of two waves is a wave of their sum and one of their difference."""
        square = self.squares.sums(np.sum(columns[0] ** 2, axis=0)[:, None])[:, 0]
        out = np.empty((len(self.which), len(self.keys), len(self.keys)))
        for a in range(self.which.shape[1]):
            for b in range(self.which.shape[1]):
                one, other = self.which[:, a], self.which[:, b]
                more, less = square[one + other], square[np.abs(one - other)]
                turned = np.sign(one - other) * less.imag
                out[:, 2 * a, 2 * b] = 0.5 * (less.real - more.real)
                out[:, 2 * a + 1, 2 * b + 1] = 0.5 * (less.real + more.real)
                out[:, 2 * a, 2 * b + 1] = 0.5 * (more.imag + turned)
                out[:, 2 * a + 1, 2 * b] = 0.5 * (more.imag - turned)
        return out

    def gram_of_sums(self, of: Sequence[Array], spectra: Spectra) -> Array:
        """See :class:`Bank`."""
        known = spectra.squares_of(self.spectrum, of[0])
        out = np.empty((len(self.which), len(self.keys), len(self.keys)))
        for a in range(self.which.shape[1]):
            rows = _range(self.which[:, a])
            out[:, 2 * a, 2 * a], out[:, 2 * a + 1, 2 * a + 1] = known.sine[rows], known.cosine[rows]
            out[:, 2 * a, 2 * a + 1] = out[:, 2 * a + 1, 2 * a] = known.both[rows]
        if self.which.shape[1] > 1:  # of a wave and that of twice as many cycles
            out[:, :2, 2:] = known.doubled[:, :, _range(self.which[:, 0])].transpose(2, 0, 1)
            out[:, 2:, :2] = out[:, :2, 2:].transpose(0, 2, 1)
        return out


@dataclass(frozen=True)
class StepBank:
    """What is −1 before a time of its own and nothing from then on, or nothing and then 1.

    order: samples in the order of time, (N,). before: how many of them are before each one's time, (C,). after: whether
    it is the part from then on that is not nothing.
    """

    effects: tuple[Effect, ...]
    keys: tuple[Key, ...]
    order: np.ndarray
    before: np.ndarray
    after: bool

    def sums(self, of: Sequence[Array], spectra: Spectra, rows: slice = ALL) -> Array:
        """See :class:`Bank`."""
        sign = 1.0 if self.after else -1.0
        edges = self._edges
        return np.stack([sign * self._part(spectra.running(self.order, edges, part))[rows] for part in of], axis=1)

    def gram_of_sums(self, of: Sequence[Array], spectra: Spectra) -> Array:
        """See :class:`Bank`."""
        return _squared(self.sums(of, spectra))

    def gram(self, columns: Sequence[Array]) -> Array:
        """See :class:`Bank`."""
        m = len(columns)
        pairs = [(a, b) for a in range(m) for b in range(a, m)]
        columns_of_both = np.stack([np.sum(columns[a] * columns[b], axis=0) for a, b in pairs], axis=1)
        both = self._part(running_sums(self.order, self._edges, columns_of_both))
        out = np.empty((len(self.before), m, m))
        for (a, b), product in zip(pairs, both.T, strict=True):
            out[:, a, b] = out[:, b, a] = product
        return out

    @cached_property
    def _edges(self) -> np.ndarray:
        """How many samples are before each of the times, each number once."""
        return np.unique(np.r_[0, self.before[self.before < len(self.order)]])

    def _part(self, running: Array) -> Array:
        """Sums on the one side of each time, (C, k), from the running sums."""
        before = running[np.searchsorted(self._edges, self.before)]
        return np.asarray(running[-1] - before if self.after else before)


def running_sums(order: np.ndarray, edges: np.ndarray, matrix: Array) -> Array:
    """Sums of the rows of a matrix (N, k), taken in this order, before each edge and of all, (edges + 1, k)."""
    running = np.zeros((len(edges) + 1, matrix.shape[1]))
    np.cumsum(np.add.reduceat(matrix[order], edges, axis=0, dtype=float), axis=0, out=running[1:])
    return running


def _squared(sums: Array) -> Array:
    """``sums sumsᵀ`` of each candidate, (C, m, m): without a product of small matrices for each where m is small."""
    if sums.shape[1] == 1:
        return np.asarray(np.einsum("cmk,cmk->c", sums, sums)[:, None, None])
    return np.asarray(sums @ sums.transpose(0, 2, 1))


def _range(rows: np.ndarray) -> slice | np.ndarray:
    """Rows as a slice, which copies nothing, where they are evenly spaced."""
    step = int(rows[1] - rows[0]) if len(rows) > 1 else 1
    even = step > 0 and bool((np.diff(rows) == step).all())
    return slice(int(rows[0]), int(rows[-1]) + 1, step) if even else rows


class SpectraOfDrivers:
    """Spectra of drivers at certain samples, each made once and as long as the longest list of candidates asks for."""

    def __init__(self, drivers: Drivers) -> None:
        self._drivers = drivers
        self._most: dict[tuple[str, float], int] = {}
        self._made: dict[tuple[str, float], tuple[Spectrum, Spectrum]] = {}

    def foresee(self, driver: str, cycles: Array, multiples: np.ndarray) -> None:
        """These cycles a turn will be asked for, and so many times as many."""
        step = wave_step(cycles)
        if step is not None:
            key = driver, round(step, 12)
            self._most[key] = max(self._most.get(key, 0), round(float(cycles.max() / step)) * int(multiples.max()))

    def of(self, driver: str, step: float) -> tuple[Spectrum, Spectrum]:
        """That of a driver, and one up to twice the highest wave."""
        key = driver, round(step, 12)
        if key not in self._made:
            x, most = self._drivers.values(driver), self._most[key]
            self._made[key] = Spectrum(x, step, most), Spectrum(x, step, 2 * most)
        return self._made[key]


def wave_step(cycles: Array) -> float | None:
    """The step of which all cycles are multiples, one after the other; None where they are not, or are few."""
    if len(cycles) < LEAST_WAVES:
        return None
    step = float(cycles[-1] - cycles[0]) / (len(cycles) - 1)
    if step <= 0.0:
        return None
    step = float(cycles[0]) / max(round(float(cycles[0]) / step), 1)
    even = np.abs(cycles - step * np.round(cycles / step)).max()
    return step if even < _SAME * step * len(cycles) else None


def gathered(banks: Iterable[NumberBank]) -> list[NumberBank]:
    """Banks of any numbers, those of the same keys made one."""
    alike: dict[tuple[Key, ...], list[NumberBank]] = {}
    for bank in banks:
        alike.setdefault(bank.keys, []).append(bank)
    return [
        NumberBank(
            tuple(e for bank in some for e in bank.effects), keys, np.concatenate([bank.numbers for bank in some])
        )
        for keys, some in alike.items()
    ]

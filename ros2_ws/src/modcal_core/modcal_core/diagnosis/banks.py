"""Candidates in banks: those that stand at the same places and directions are contracted with anything at once.

Every candidate is a direction at a place times numbers, one a sample. What is asked of a bank are sums over the samples
of its numbers times something: times the residual under the signs of each trial, times the projector, and, for the
products of its columns with each other, times their squares. Two kinds of numbers have two ways to sum:

* waves of a joint's angle, nine in ten of all candidates: an FFT (:mod:`spectra`);
* all others: products of matrices, one for each place and direction.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from modcal_core.diagnosis.spectra import Key, KnownSums, Spectrum
from modcal_core.effects import Effect
from modcal_core.geometry import Array

MIN_WAVES = 32  # below that an FFT costs more than it saves
_SAME = 1e-9  # of a step


class Bank(Protocol):
    """C candidates of m columns each. keys: the places and directions of its columns, each once. width: m."""

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The candidates, (C,)."""
        ...

    @property
    def keys(self) -> tuple[Key, ...]:
        """The places and directions of its columns."""
        ...

    @property
    def width(self) -> int:
        """How many columns each candidate has."""
        ...

    def sums(self, of: Mapping[Key, Array], known: KnownSums) -> Array:
        """Numbers of each candidate times the matrix (N, k) of each column's key, (C, m, k)."""
        ...

    def gram(self, columns: Mapping[Key, Array]) -> Array:
        """Products of each candidate's columns with each other (C, m, m). columns: unit columns (6, N) of each key."""
        ...


@dataclass(frozen=True)
class WaveBank:
    """Sines and cosines along one driver at one place and direction, m/2 of either a candidate: of one wave, or of one
    and that of twice as many cycles. which: their numbers in the spectrum, (C, m/2).
    """

    effects: tuple[Effect, ...]
    key: Key
    which: np.ndarray
    spectrum: Spectrum

    @property
    def keys(self) -> tuple[Key, ...]:
        """See :class:`Bank`."""
        return (self.key,)

    @property
    def width(self) -> int:
        """See :class:`Bank`."""
        return 2 * self.which.shape[1]

    def sums(self, of: Mapping[Key, Array], known: KnownSums) -> Array:
        """See :class:`Bank`."""
        columns = of[self.key]
        waves = known.once("waves", self.spectrum, columns, lambda: self.spectrum.sums(columns))
        each = [waves[among] for among in self._ranges]
        return each[0] if len(each) == 1 else np.concatenate(each, axis=1)

    @cached_property
    def _ranges(self) -> list[slice | np.ndarray]:
        """Where the waves of each candidate's first, second, … number are, (C,) each."""
        return [_range(which) for which in self.which.T]

    def gram(self, columns: Mapping[Key, Array]) -> Array:
        """See :class:`Bank`."""
        return self.spectrum.gram(self.which, np.sum(columns[self.key] ** 2, axis=0))


@dataclass(frozen=True)
class NumberBank:
    """Candidates of any numbers, (C, m, N), at the same places and directions, one for each column."""

    effects: tuple[Effect, ...]
    of_columns: tuple[Key, ...]
    numbers: Array

    @property
    def keys(self) -> tuple[Key, ...]:
        """See :class:`Bank`."""
        return tuple(dict.fromkeys(self.of_columns))

    @property
    def width(self) -> int:
        """See :class:`Bank`."""
        return len(self.of_columns)

    def sums(self, of: Mapping[Key, Array], known: KnownSums) -> Array:
        """See :class:`Bank`."""
        C, m, N = self.numbers.shape
        out = np.empty((C, m, of[self.of_columns[0]].shape[1]))
        for key, some in self.groups().items():
            out[:, some] = (self.numbers[:, some].reshape(-1, N) @ of[key]).reshape(C, len(some), -1)
        return out

    def groups(self) -> dict[Key, list[int]]:
        """The columns of each key."""
        return {one: [a for a, key in enumerate(self.of_columns) if key == one] for one in self.keys}

    def gram(self, columns: Mapping[Key, Array]) -> Array:
        """See :class:`Bank`."""
        C, m, _ = self.numbers.shape
        groups = list(self.groups().items())
        if m == 1:
            return np.asarray((self.numbers[:, 0] ** 2 @ np.sum(columns[groups[0][0]] ** 2, axis=0))[:, None, None])
        numbers = self.numbers
        if len(groups) == 1:
            square = np.sum(columns[groups[0][0]] ** 2, axis=0)
            return np.asarray((numbers * square) @ numbers.transpose(0, 2, 1))
        out = np.empty((C, m, m))
        for i, (one, some) in enumerate(groups):
            for other, others in groups[i:]:
                both = np.sum(columns[one] * columns[other], axis=0)
                product = (numbers[:, some] * both) @ numbers[:, others].transpose(0, 2, 1)
                for k, a in enumerate(some):
                    out[:, a, others], out[:, others, a] = product[:, k], product[:, k]
        return out


class NumberPool:
    """The numbers of many candidates, each once for a key: for each key what they ask for is one product."""

    def __init__(self, banks: Iterable[NumberBank]) -> None:
        found: dict[Key, list[tuple[int, int, Array]]] = {}
        self._rows: dict[int, np.ndarray] = {}
        for bank in banks:
            self._rows[id(bank)] = np.empty(bank.numbers.shape[:2], np.int64)
            for key, some in bank.groups().items():
                found.setdefault(key, []).extend((id(bank), a, bank.numbers[:, a]) for a in some)
        self._numbers: dict[Key, np.ndarray] = {}
        first = 0
        for key, several in found.items():
            once, which = _each_once(np.concatenate([numbers for _, _, numbers in several]))
            for bank_id, a, numbers in several:
                self._rows[bank_id][:, a], which = first + which[: len(numbers)], which[len(numbers) :]
            self._numbers[key] = once
            first += len(once)
        self._count = first

    def rows(self, bank: NumberBank) -> np.ndarray:
        """Which of all numbers, key after key, the columns of each candidate of a bank have, (C, m)."""
        return self._rows[id(bank)]

    def times(self, of: Mapping[Key, Array]) -> Array:
        """All numbers times the matrices (N, k) of their keys, (R, k)."""
        some = of[next(iter(self._numbers))]
        out = np.empty((self._count, some.shape[1]), some.dtype)
        first = 0
        for key, numbers in self._numbers.items():
            np.matmul(numbers.astype(some.dtype, copy=False), of[key], out=out[first : first + len(numbers)])
            first += len(numbers)
        return out


def _each_once(numbers: Array) -> tuple[Array, np.ndarray]:
    """Rows (R, N) of which no two are the same, and which of them each of these is."""
    seen: dict[bytes, int] = {}
    which = np.array([seen.setdefault(row.tobytes(), len(seen)) for row in numbers], np.int64)
    first = np.unique(which, return_index=True)[1]
    return numbers[first], which


@dataclass(frozen=True)
class GatheredBank:
    """Banks of any numbers, of as many columns each, as one. pool: what has their numbers."""

    parts: tuple[NumberBank, ...]
    pool: NumberPool

    @cached_property
    def effects(self) -> tuple[Effect, ...]:
        """See :class:`Bank`."""
        return tuple(effect for part in self.parts for effect in part.effects)

    @cached_property
    def keys(self) -> tuple[Key, ...]:
        """See :class:`Bank`."""
        return tuple(dict.fromkeys(key for part in self.parts for key in part.keys))

    @property
    def width(self) -> int:
        """See :class:`Bank`."""
        return self.parts[0].width

    def sums(self, of: Mapping[Key, Array], known: KnownSums) -> Array:
        """See :class:`Bank`."""
        return np.asarray(known.once("numbers", self.pool, of, lambda: self.pool.times(of))[self._rows])

    def gram(self, columns: Mapping[Key, Array]) -> Array:
        """See :class:`Bank`."""
        return np.concatenate([part.gram(columns) for part in self.parts])

    @cached_property
    def _rows(self) -> np.ndarray:
        """Which of the pool's numbers each candidate's columns have, (C, m)."""
        return np.concatenate([self.pool.rows(part) for part in self.parts])


def gathered(banks: Iterable[NumberBank]) -> list[NumberBank]:
    """Banks of any numbers, those of the same columns made one."""
    alike: dict[tuple[Key, ...], list[NumberBank]] = {}
    for bank in banks:
        alike.setdefault(bank.of_columns, []).append(bank)
    return [
        NumberBank(tuple(e for bank in some for e in bank.effects), of, np.concatenate([bank.numbers for bank in some]))
        for of, some in alike.items()
    ]


def _range(rows: np.ndarray) -> slice | np.ndarray:
    """Rows as a slice, which copies nothing, where they are evenly spaced."""
    step = int(rows[1] - rows[0]) if len(rows) > 1 else 1
    even = step > 0 and bool((np.diff(rows) == step).all())
    return slice(int(rows[0]), int(rows[-1]) + 1, step) if even else rows


def wave_step(cycles: Array) -> float | None:
    """The step of which all cycles are multiples, one after the other; None where they are not, or are few."""
    if len(cycles) < MIN_WAVES:
        return None
    step = float(cycles[-1] - cycles[0]) / (len(cycles) - 1)
    if step <= 0.0:
        return None
    step = float(cycles[0]) / max(round(float(cycles[0]) / step), 1)
    even = np.abs(cycles - step * np.round(cycles / step)).max()
    return step if even < _SAME * step * len(cycles) else None

"""Candidates of any numbers: what is asked of them are products of matrices, one for each place and direction."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from modcal_core.diagnosis.spectra import Key, KnownSums, squared
from modcal_core.effects import Effect
from modcal_core.geometry import Array

ALL = slice(None)
_MANY = 200_000  # numbers; with fewer, double precision costs nothing worth saving


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

    def sums(self, of: Mapping[Key, Array], known: KnownSums, rows: slice = ALL) -> Array:
        """See :class:`Bank`."""
        numbers = self.numbers[rows]
        C, m, N = numbers.shape
        out = np.empty((C, m, of[self.of_columns[0]].shape[1]))
        for key, some in self.groups().items():
            out[:, some] = (numbers[:, some].reshape(-1, N) @ of[key]).reshape(C, len(some), -1)
        return out

    def groups(self) -> dict[Key, list[int]]:
        """The columns of each key."""
        return {one: [a for a, key in enumerate(self.of_columns) if key == one] for one in self.keys}

    def gram_of_sums(self, of: Mapping[Key, Array], known: KnownSums) -> Array:
        """See :class:`Bank`."""
        return squared(self.sums(of, known))

    def gram(self, columns: Mapping[Key, Array]) -> Array:
        """See :class:`Bank`."""
        C, m, _ = self.numbers.shape
        groups = list(self.groups().items())
        if m == 1:
            return np.asarray((self.numbers[:, 0] ** 2 @ np.sum(columns[groups[0][0]] ** 2, axis=0))[:, None, None])
        numbers = self._lean
        if len(groups) == 1:
            square = np.sum(columns[groups[0][0]] ** 2, axis=0).astype(numbers.dtype, copy=False)
            return np.asarray((numbers * square) @ numbers.transpose(0, 2, 1), dtype=float)
        out = np.empty((C, m, m))
        for i, (one, some) in enumerate(groups):
            for other, others in groups[i:]:
                both = np.sum(columns[one] * columns[other], axis=0).astype(numbers.dtype, copy=False)
                product = (numbers[:, some] * both) @ numbers[:, others].transpose(0, 2, 1)
                for k, a in enumerate(some):
                    out[:, a, others], out[:, others, a] = product[:, k], product[:, k]
        return out

    @cached_property
    def _lean(self) -> np.ndarray:
        """The numbers, many of them in single precision: as what lies along many directions (:mod:`space`)."""
        return self.numbers.astype(np.float32) if self.numbers.size > _MANY else self.numbers


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
        for key, numbers in (self._lean if some.dtype == np.float32 else self._numbers).items():
            np.matmul(numbers, of[key], out=out[first : first + len(numbers)])
            first += len(numbers)
        return out

    @cached_property
    def _lean(self) -> dict[Key, np.ndarray]:
        return {key: numbers.astype(np.float32) for key, numbers in self._numbers.items()}


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

    def sums(self, of: Mapping[Key, Array], known: KnownSums, rows: slice = ALL) -> Array:
        """See :class:`Bank`."""
        return np.asarray(known.numbers(self.pool, of)[self._rows[rows]])

    def gram(self, columns: Mapping[Key, Array]) -> Array:
        """See :class:`Bank`."""
        return np.concatenate([part.gram(columns) for part in self.parts])

    def gram_of_sums(self, of: Mapping[Key, Array], known: KnownSums) -> Array:
        """See :class:`Bank`."""
        return squared(self.sums(of, known))

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

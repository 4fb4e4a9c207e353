"""Candidates of any numbers: what is asked of them are products of matrices, one for each place and direction."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from modcal_core.diagnosis.known_sums import Key, KnownSums, squared
from modcal_core.effects.effect import Effect
from modcal_core.geometry.so3 import Array

ALL = slice(None)


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
        if len(groups) == 1:
            square = np.sum(columns[groups[0][0]] ** 2, axis=0)
            return np.asarray((self.numbers * square) @ self.numbers.transpose(0, 2, 1))
        out = np.empty((C, m, m))
        for i, (one, some) in enumerate(groups):
            for other, others in groups[i:]:
                both = np.sum(columns[one] * columns[other], axis=0)
                product = (self.numbers[:, some] * both) @ self.numbers[:, others].transpose(0, 2, 1)
                for k, a in enumerate(some):
                    out[:, a, others], out[:, others, a] = product[:, k], product[:, k]
        return out


@dataclass(frozen=True)
class GatheredBank:
    """Banks of any numbers, of as many columns each, as one: for each key what they ask for is one product."""

    parts: tuple[NumberBank, ...]

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
        return np.asarray(known.numbers(self, of)[self._rows[rows]])

    def gram(self, columns: Mapping[Key, Array]) -> Array:
        """See :class:`Bank`."""
        return np.concatenate([part.gram(columns) for part in self.parts])

    def gram_of_sums(self, of: Mapping[Key, Array], known: KnownSums) -> Array:
        """See :class:`Bank`."""
        return squared(self.sums(of, known))

    def times(self, of: Mapping[Key, Array]) -> Array:
        """All numbers times the matrices (N, k) of their keys, (R, k)."""
        some = of[self.keys[0]]
        lean = some.dtype == np.float32
        out = np.empty((self._rows.size, some.shape[1]), some.dtype)
        first = 0
        for key in self.keys:
            numbers = (self._lean if lean else self._numbers)[key]
            np.matmul(numbers, of[key], out=out[first : first + len(numbers)])
            first += len(numbers)
        return out

    @cached_property
    def _numbers(self) -> dict[Key, np.ndarray]:
        """Numbers of all columns of each key, (R_key, N)."""
        out: dict[Key, list[np.ndarray]] = {key: [] for key in self.keys}
        for part in self.parts:
            for key, some in part.groups().items():
                out[key].append(part.numbers[:, some].reshape(-1, part.numbers.shape[2]))
        return {key: np.concatenate(numbers) for key, numbers in out.items()}

    @cached_property
    def _lean(self) -> dict[Key, np.ndarray]:
        return {key: numbers.astype(np.float32) for key, numbers in self._numbers.items()}

    @cached_property
    def _rows(self) -> np.ndarray:
        """Which of all numbers, key after key, each candidate's columns have, (C, m)."""
        next_of = dict(zip(self.keys, np.cumsum([0, *(len(self._numbers[key]) for key in self.keys)]), strict=False))
        out = []
        for part in self.parts:
            rows = np.empty((len(part.effects), self.width), np.int64)
            for key, some in part.groups().items():
                rows[:, some] = next_of[key] + np.arange(rows[:, some].size).reshape(-1, len(some))
                next_of[key] += rows[:, some].size
            out.append(rows)
        return np.concatenate(out)


def gathered(banks: Iterable[NumberBank]) -> list[NumberBank]:
    """Banks of any numbers, those of the same columns made one."""
    alike: dict[tuple[Key, ...], list[NumberBank]] = {}
    for bank in banks:
        alike.setdefault(bank.of_columns, []).append(bank)
    return [
        NumberBank(tuple(e for bank in some for e in bank.effects), of, np.concatenate([bank.numbers for bank in some]))
        for of, some in alike.items()
    ]

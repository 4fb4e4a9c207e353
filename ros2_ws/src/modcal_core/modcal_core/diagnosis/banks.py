"""Candidates in banks: those that stand at the same places and directions are contracted with anything at once.

Every candidate is a direction at a place times numbers, one a sample. What is asked of a bank are sums over the samples
of its numbers times something: times the residual under the signs of each trial, times the projector, and, for the
products of its columns with each other, times their squares. Two kinds of numbers have two ways to sum:

* waves of a joint's angle, nine in ten of all candidates: an FFT (:mod:`spectra`);
* all others: products of matrices, one for each place and direction.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from modcal_core.diagnosis.spectra import Key, Spectrum
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

    def sums(self, of: Mapping[Key, Array]) -> Array:
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

    def sums(self, of: Mapping[Key, Array]) -> Array:
        """See :class:`Bank`."""
        waves = self.spectrum.sums(of[self.key])
        return np.concatenate([waves[among] for among in self.which.T], axis=1)

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

    def sums(self, of: Mapping[Key, Array]) -> Array:
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


class GatheredBank:
    """Banks of any numbers, of as many columns each, as one: each number stands once, and a key takes one product."""

    def __init__(self, parts: Sequence[NumberBank]) -> None:
        self._parts = parts
        self.effects = tuple(effect for part in parts for effect in part.effects)
        self.keys = tuple(dict.fromkeys(key for part in parts for key in part.keys))
        self.width = parts[0].width
        found: dict[Key, list[tuple[int, int]]] = {}
        for i, part in enumerate(parts):
            for a, key in enumerate(part.of_columns):
                found.setdefault(key, []).append((i, a))
        rows = [np.empty(part.numbers.shape[:2], np.int64) for part in parts]
        self._numbers: dict[Key, Array] = {}
        count = 0
        for key, several in found.items():
            once, which = _each_once(np.concatenate([parts[i].numbers[:, a] for i, a in several]))
            for i, a in several:
                rows[i][:, a], which = count + which[: len(rows[i])], which[len(rows[i]) :]
            self._numbers[key] = once
            count += len(once)
        self._rows = np.concatenate(rows)  # which of all numbers, key after key, each candidate's columns have, (C, m)

    def sums(self, of: Mapping[Key, Array]) -> Array:
        """See :class:`Bank`."""
        out = np.concatenate([numbers @ of[key] for key, numbers in self._numbers.items()])
        return out[self._rows]

    def gram(self, columns: Mapping[Key, Array]) -> Array:
        """See :class:`Bank`."""
        return np.concatenate([part.gram(columns) for part in self._parts])


def _each_once(numbers: Array) -> tuple[Array, np.ndarray]:
    """Rows (R, N) of which no two are the same, and which of them each of these is."""
    seen: dict[bytes, int] = {}
    which = np.array([seen.setdefault(row.tobytes(), len(seen)) for row in numbers], np.int64)
    first = np.unique(which, return_index=True)[1]
    return numbers[first], which


def gathered(banks: Iterable[NumberBank]) -> list[NumberBank]:
    """Banks of any numbers, those of the same columns made one."""
    alike: dict[tuple[Key, ...], list[NumberBank]] = {}
    for bank in banks:
        alike.setdefault(bank.of_columns, []).append(bank)
    return [
        NumberBank(tuple(e for bank in some for e in bank.effects), of, np.concatenate([bank.numbers for bank in some]))
        for of, some in alike.items()
    ]


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

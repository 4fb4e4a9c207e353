"""Candidates in banks: those that stand at the same places and directions are contracted with anything at once.

Every candidate is a direction at a place times numbers, one a sample. What is asked of a bank are sums over the samples
of its numbers times something: times the residual under the signs of each trial, times the projector, and, for the
products of its columns with each other, times their squares. Three kinds of numbers need three ways to sum:

* waves of a joint's angle, nine in ten of all candidates: a table of them, or an FFT (:mod:`spectra`);
* what begins or ends at some time: running sums in the order of time;
* all others: products of matrices, one for each place and direction.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from modcal_core.diagnosis.number_banks import ALL
from modcal_core.diagnosis.spectra import Key, KnownSums, Parts, Spectrum, squared
from modcal_core.effects import Drivers, Effect
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

    def sums(self, of: Mapping[Key, Array], known: KnownSums, rows: slice = ALL) -> Array:
        """Numbers of some candidates times the matrix (N, k) of each column's key, (C, m, k)."""
        ...

    def gram(self, columns: Mapping[Key, Array]) -> Array:
        """Products of each candidate's columns with each other (C, m, m). columns: unit columns (6, N) of each key."""
        ...

    def gram_of_sums(self, of: Mapping[Key, Array], known: KnownSums) -> Array:
        """Products with each other, (C, m, m), of the sums with the columns of the matrices (N, k)."""
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

    def sums(self, of: Mapping[Key, Array], known: KnownSums, rows: slice = ALL) -> Array:
        """See :class:`Bank`."""
        waves = known.waves(self.spectrum, of[self.key])
        each = [waves[_part(among, rows)] for among in self._ranges]
        return each[0] if len(each) == 1 else np.concatenate(each, axis=1)

    @cached_property
    def _ranges(self) -> list[slice | np.ndarray]:
        """Where the waves of each candidate's first, second, … number are, (C,) each."""
        return [_range(which) for which in self.which.T]

    def gram(self, columns: Mapping[Key, Array]) -> Array:
        """See :class:`Bank`."""
        return self.spectrum.gram(self.which, np.sum(columns[self.key] ** 2, axis=0))

    def gram_of_sums(self, of: Mapping[Key, Array], known: KnownSums) -> Array:
        """See :class:`Bank`."""
        squares = known.squares(self.spectrum, of[self.key])
        out = np.empty((len(self.which), self.width, self.width))
        for a, rows in enumerate(self._ranges):
            out[:, 2 * a, 2 * a], out[:, 2 * a + 1, 2 * a + 1] = squares.sine[rows], squares.cosine[rows]
            out[:, 2 * a, 2 * a + 1] = out[:, 2 * a + 1, 2 * a] = squares.both[rows]
        if self.which.shape[1] > 1:  # of a wave and that of twice as many cycles
            out[:, :2, 2:] = squares.doubled[:, :, self._ranges[0]].transpose(2, 0, 1)
            out[:, 2:, :2] = out[:, :2, 2:].transpose(0, 2, 1)
        return out


@dataclass(frozen=True)
class StepBank:
    """What is −1 before a time of its own and nothing from then on, or nothing and then 1.

    parts: samples between the times. at: which of these begins with each one's time, (C,). after: whether it is what is
    from then on that is not nothing.
    """

    effects: tuple[Effect, ...]
    keys: tuple[Key, ...]
    parts: Parts
    at: np.ndarray
    after: bool

    @property
    def width(self) -> int:
        """See :class:`Bank`."""
        return len(self.keys)

    def sums(self, of: Mapping[Key, Array], known: KnownSums, rows: slice = ALL) -> Array:
        """See :class:`Bank`."""
        sign = 1.0 if self.after else -1.0
        each = [self._part(known.running(self.parts, of[key]))[rows] for key in self.keys]
        return sign * np.stack(each, axis=1)

    def gram_of_sums(self, of: Mapping[Key, Array], known: KnownSums) -> Array:
        """See :class:`Bank`."""
        return squared(self.sums(of, known))

    def gram(self, columns: Mapping[Key, Array]) -> Array:
        """See :class:`Bank`."""
        m, each = self.width, [columns[key] for key in self.keys]
        pairs = [(a, b) for a in range(m) for b in range(a, m)]
        columns_of_both = np.stack([np.sum(each[a] * each[b], axis=0) for a, b in pairs], axis=1)
        both = self._part(self.parts.running(columns_of_both))
        out = np.empty((len(self.at), m, m))
        for (a, b), product in zip(pairs, both.T, strict=True):
            out[:, a, b] = out[:, b, a] = product
        return out

    def _part(self, running: Array) -> Array:
        """Sums on the one side of each time, (C, k), from the running sums."""
        before = running[self.at]
        return np.asarray(running[-1] - before if self.after else before)


def _range(rows: np.ndarray) -> slice | np.ndarray:
    """Rows as a slice, which copies nothing, where they are evenly spaced."""
    step = int(rows[1] - rows[0]) if len(rows) > 1 else 1
    even = step > 0 and bool((np.diff(rows) == step).all())
    return slice(int(rows[0]), int(rows[-1]) + 1, step) if even else rows


def _part(among: slice | np.ndarray, rows: slice) -> slice | np.ndarray:
    """Some rows of those."""
    if isinstance(among, np.ndarray):
        return among[rows]
    some = range(among.start, among.stop, among.step)[rows]
    return slice(some.start, some.stop, some.step)


class SpectraOfDrivers:
    """Spectra of drivers at certain samples, each made once and as long as the longest list of candidates asks for."""

    def __init__(self, drivers: Drivers) -> None:
        self._drivers = drivers
        self._most: dict[tuple[str, float], int] = {}
        self._made: dict[tuple[str, float], Spectrum] = {}

    def foresee(self, driver: str, cycles: Array, multiples: np.ndarray) -> None:
        """Note that these cycles a turn will be asked for, and that many multiples."""
        step = wave_step(cycles)
        if step is not None:
            key = driver, round(step, 12)
            self._most[key] = max(self._most.get(key, 0), round(float(cycles.max() / step)) * int(multiples.max()))

    def of(self, driver: str, step: float) -> Spectrum:
        """Spectrum of a driver."""
        key = driver, round(step, 12)
        if key not in self._made:
            self._made[key] = Spectrum(self._drivers.values(driver), step, self._most[key])
        return self._made[key]


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

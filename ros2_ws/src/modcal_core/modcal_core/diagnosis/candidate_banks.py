"""Candidates of a scan in banks: similar ones are evaluated together."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property
from itertools import groupby, pairwise

import numpy as np

from modcal_core.calibration import independent_unit
from modcal_core.diagnosis.banks import Bank, SpectraOfDrivers, StepBank, WaveBank, wave_step
from modcal_core.diagnosis.number_banks import GatheredBank, NumberBank, NumberPool, gathered
from modcal_core.diagnosis.spectra import Key, Parts
from modcal_core.effects import (
    AXIS,
    LENGTH,
    PERIODIC,
    STEPS,
    USUAL,
    Drivers,
    Effect,
    columns,
    complexity,
    periodic,
    place_index,
    plain_columns,
)
from modcal_core.geometry import Array


class BankedCandidates:
    """Candidates at certain samples, in banks."""

    def __init__(self, effects: Sequence[Effect], drivers: Drivers) -> None:
        """effects: the candidates. drivers: at the samples they are looked for on."""
        self.drivers = drivers
        self._composed: dict[Key, list[tuple[int, int, Array | float]]] = {}
        self._parts: dict[tuple[str, bytes], Parts] = {}  # between the times of steps
        spectra = SpectraOfDrivers(drivers)
        lists = _alike(effects)
        for alike in lists:
            if alike[0].shape.kind in PERIODIC and len(alike) > 1:
                spectra.foresee(alike[0].driver, _cycles(alike), _multiples(alike[0]))
        several: list[Bank] = []
        single: list[NumberBank] = []
        for alike in lists:
            bank = self._at_once(alike, spectra) if len(alike) > 1 else None
            if isinstance(bank, NumberBank):
                single.append(bank)
            elif bank is not None:
                several.append(bank)
            else:
                factors = [(effect, *self._factor(effect)) for effect in alike]
                single += [NumberBank((effect,), keys, numbers[None]) for effect, keys, numbers in factors]
        banks: list[Bank] = sorted([*several, *gathered(single)], key=lambda bank: bank.width)
        self.effects = tuple(effect for bank in banks for effect in bank.effects)
        self.complexity = np.array([complexity(effect) for effect in self.effects], dtype=int)
        ends = np.cumsum([0, *(len(bank.effects) for bank in banks)])
        least = [int(self.complexity[first:last].min()) for first, last in pairwise(ends)]
        both = list(_gathered(zip(banks, least, strict=True)))
        self.banks: list[Bank] = [bank for bank, _ in both]
        self._least = {id(bank): plainest for bank, plainest in both}
        self._keys = tuple(dict.fromkeys(key for bank in self.banks for key in bank.keys))
        self.unit = independent_unit(drivers.samples)

    def _at_once(self, alike: list[Effect], spectra: SpectraOfDrivers) -> Bank:
        """The bank of candidates that differ in their cycles or times alone."""
        first, effects = alike[0], tuple(alike)
        keys, _ = self._factor(first)
        x = self.drivers.values(first.driver)
        if first.shape.kind in STEPS:
            parts, at = self._parts_at(first.driver, x, [e.shape.settings["at"] for e in alike])
            return StepBank(effects, keys, parts, at, first.shape.kind == "step")
        cycles = _cycles(alike)
        step = wave_step(cycles)
        if step is None:
            return NumberBank(effects, keys, periodic(first.shape.kind, cycles, x))
        which = np.round(cycles / step).astype(np.int64)[:, None] * _multiples(first)
        return WaveBank(effects, keys[0], which, spectra.of(first.driver, step))

    def _parts_at(self, driver: str, x: Array, times: Sequence[float]) -> tuple[Parts, np.ndarray]:
        """The samples between some values of a driver, and which part begins with each, (C,).

        x: the driver's, (N,).
        """
        order = np.argsort(x, kind="stable")
        before = np.searchsorted(x[order], times)
        edges = np.unique(np.r_[0, before[before < len(order)]])
        key = driver, edges.tobytes()
        if key not in self._parts:
            self._parts[key] = Parts(order, edges)
        return self._parts[key], np.searchsorted(edges, before)

    def _factor(self, effect: Effect) -> tuple[tuple[Key, ...], Array]:
        """The directions at places of an effect's columns, and their numbers (m, N)."""
        if (plain := plain_columns(effect, self.drivers)) is not None:
            return tuple(plain[0]), plain[1]
        terms = columns(effect, self.drivers)
        if all(len(t) == 1 for t in terms):
            return tuple((t[0].place, t[0].direction) for t in terms), np.stack([t[0].size for t in terms])
        if effect.direction == LENGTH:
            k = place_index(effect.place, self.drivers.arm.chain)
            along = self.drivers.arm.chain.length_direction(k)
            key: Key = (k, LENGTH)
            self._composed[key] = [(k, d, float(along[d])) for d in range(3)]
            basis = effect.shape.basis(self.drivers.values(effect.driver, effect.lag))
            return (key,) * len(basis), basis
        keys: list[Key] = []
        for i, several in enumerate(terms):
            own = f" {i} {sorted(effect.shape.settings.items())}" if len(terms) > 1 or effect.shape.settings else ""
            keys.append((several[0].place, effect.direction + effect.driver + own))
            self._composed[keys[-1]] = [(t.place, t.direction, t.size) for t in several]
        return tuple(keys), np.ones((len(keys), len(self.drivers)))

    def numbers_of(self, key: tuple[str, str, str, str]) -> list[int]:
        """The numbers of the candidates that are one entry of a report."""
        return self._of_each_key.get(key, [])

    @cached_property
    def _of_each_key(self) -> dict[tuple[str, str, str, str], list[int]]:
        found: dict[tuple[str, str, str, str], list[int]] = {}
        for i, effect in enumerate(self.effects):
            found.setdefault(effect.key, []).append(i)
        return found

    def _plainest(self, bank: Bank) -> int:
        """The least complexity among the candidates of a bank."""
        return self._least[id(bank)]

    def _is_own(self, bank: Bank) -> bool:
        """Whether it is one of the scanner's banks, which stay as long as it does."""
        return id(bank) in self._least


def _gathered(banks: Iterable[tuple[Bank, int]]) -> Iterator[tuple[Bank, int]]:
    """Banks in their order; neighbours of any numbers, alike in width and in the number beside them, made one.

    Those of plain candidates have one pool of numbers, and all others another, which is not asked where they take no
    part.
    """
    banks = list(banks)
    of_numbers = [(bank, least <= USUAL) for bank, least in banks if isinstance(bank, NumberBank)]
    pools = {plain: NumberPool(bank for bank, p in of_numbers if p == plain) for plain in (True, False)}
    for (_, least, numbers), some in groupby(banks, lambda b: (b[0].width, b[1], isinstance(b[0], NumberBank))):
        if numbers:
            parts = tuple(bank for bank, _ in some if isinstance(bank, NumberBank))
            yield GatheredBank(parts, pools[least <= USUAL]), least
        else:
            yield from some


def _cycles(alike: list[Effect]) -> Array:
    return np.array([e.shape.settings["cycles"] for e in alike])


def _multiples(effect: Effect) -> np.ndarray:
    """What times its cycles the waves of a periodic effect have."""
    return np.arange(1, effect.shape.size // 2 + 1)


def _alike(effects: Sequence[Effect]) -> list[list[Effect]]:
    """The effects in lists: those that differ in their cycles or their times alone are set up at once.

    Nine in ten candidates are of that kind.
    """
    lists: dict[object, list[Effect]] = {}
    for i, effect in enumerate(effects):
        kind = effect.shape.kind
        repeats = kind in PERIODIC and effect.direction == AXIS
        begins = kind in STEPS and effect.direction != LENGTH
        key = (effect.place, effect.direction, effect.driver, kind) if repeats or begins else i
        lists.setdefault(key, []).append(effect)
    return list(lists.values())

"""How much each candidate effect would explain of what a fit leaves over: it proposes, and a fit decides.

A candidate's columns are the derivatives of the readings with respect to its amplitudes. What the fitted parameters
could still explain is projected out of residual and candidates, so nothing is found that they could have taken up.

Every candidate is a direction at a place times numbers, one a sample. So each (place, direction) is contracted with the
residual and with the projector once, and the thousands of candidates that share it cost sums with their numbers
(:mod:`banks`).

Noise is not white in a tracker's frame: a joint that does not repeat throws the tool along its own columns. What can be
relied on is that stations are independent and their noise is as likely to point one way as the other. So the residual
vectors of whole stations are given random signs as well, and the best candidate found in such a recording of pure noise
is noted (wild bootstrap; Wu 1986, Liu 1988). Those maxima follow an extreme-value law (Gumbel), which gives the chance
that noise makes a best as good as the real one, all candidates looked at included.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import groupby
from typing import Any

import numpy as np

from modcal_core.calibration import Fit, beyond_gumbel, gumbel_of, independent_unit, log10_beyond_f
from modcal_core.diagnosis.banks import (
    Bank,
    GatheredBank,
    NumberBank,
    WaveBank,
    gathered,
    wave_step,
)
from modcal_core.diagnosis.space import Space
from modcal_core.diagnosis.spectra import Key, Spectrum, squared
from modcal_core.effects import (
    AXIS,
    LENGTH,
    PERIODIC,
    Drivers,
    Effect,
    columns,
    complexity,
    periodic,
    place_index,
    plain_columns,
)
from modcal_core.geometry import Array

MIN_FREEDOM = 20  # rows beyond what is fitted
_ONLY_ROUNDING = 1e-13  # added to what is inverted, so that it can be
# A column is nothing whose square is less of the largest, as where a sample touches the end of a curve's function by
# rounding; and where all are less than that, which no sample shows
_ROUNDING, _NO_SQUARE = 1e-24, 1e-30
_MIN_NEW = 0.0025  # share of a candidate's square (5 % of its size) that the fit cannot make by itself
_TRIALS = 79  # with random signs: their law's location is known to a ninth of its scale
_KEPT = 2  # fits whose rows are kept beside those of the last: a look ahead, and back


@dataclass(frozen=True)
class Evidence:
    """What C candidates explain. effects: the candidates. explained: share of the residual's squares, (C,). score: how
    unlikely that share would be of white noise, −log10 p, (C,). freedom: rows beyond what is fitted. complexity: how
    much it takes to believe each, (C,). noise: the best score in each trial, (trials,); empty where none was made.
    """

    effects: tuple[Effect, ...]
    explained: Array
    score: Array
    freedom: int
    complexity: np.ndarray
    noise: Array

    @property
    def p_value(self) -> float:
        """The chance that pure noise would have as good a best."""
        return self.chance(float(self.score.max(initial=0.0)))

    def chance(self, score: float) -> float:
        """The chance that pure noise would have a best of this score; 1 where no trials were made."""
        if not len(self.noise):
            return 1.0
        # within the trials their own count is the better witness; beyond them the law has to do
        if score > self.noise.max():
            return max(beyond_gumbel(score, *gumbel_of(self.noise)), 1e-300)
        return float((self.noise >= score).sum() + 1) / (len(self.noise) + 1)

    @cached_property
    def inflation(self) -> float:
        """How much larger scores of this noise are than those of white noise."""
        if not len(self.noise):
            return 1.0
        return max(1.0, float(np.median(self.noise)) / max(np.log10(len(self.effects)) - 0.5, 1.0))


class Scanner:
    """Candidates at certain samples, set up once and weighed against the residual of any fit."""

    def __init__(
        self, effects: Sequence[Effect], drivers: Drivers, space: Callable[[Any, Drivers], Space] = Space.of
    ) -> None:
        """effects: the candidates. drivers: at the samples they are looked for on. space: of a fit at these samples."""
        self.drivers, self._space = drivers, space
        self._composed: dict[Key, list[tuple[int, int, Array | float]]] = {}
        self._spectra: dict[tuple[str, float], Spectrum] = {}  # as long as the longest list of candidates asks for
        lists = sorted(_alike(effects), key=lambda alike: -_highest(alike))
        several: list[Bank] = []
        single: list[NumberBank] = []
        for alike in lists:
            bank = self._at_once(alike) if len(alike) > 1 else None
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
        self._numbers: dict[tuple[str, str, str, str], list[int]] = {}
        for i, effect in enumerate(self.effects):
            self._numbers.setdefault(effect.key, []).append(i)
        self.banks = list(_gathered(banks))
        self._keys = tuple(dict.fromkeys(key for bank in self.banks for key in bank.keys))
        self.unit = independent_unit(drivers.samples)
        self._seen: list[tuple[Fit, Space]] = []

    def _at_once(self, alike: list[Effect]) -> Bank:
        """The bank of candidates that differ in their cycles alone."""
        first, effects = alike[0], tuple(alike)
        keys, _ = self._factor(first)
        x = self.drivers.values(first.driver)
        cycles = _cycles(alike)
        step = wave_step(cycles)
        if step is None:
            return NumberBank(effects, keys, periodic(first.shape.kind, cycles, x))
        which = np.round(cycles / step).astype(np.int64)[:, None] * _multiples(first)
        key = first.driver, round(step, 12)
        if key not in self._spectra:
            self._spectra[key] = Spectrum(x, step, int(which.max()))
        return WaveBank(effects, keys[0], which, self._spectra[key])

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
        return self._numbers.get(key, [])

    def space_of(self, fit: Fit) -> Space:
        """The rows of this fit at the samples."""
        for known, space in self._seen:
            if known is fit:
                return space
        found = self._space(fit, self.drivers)
        self._seen = [*self._seen[-_KEPT:], (fit, found)]
        return found

    def evidence(self, fit: Fit, trials: bool = False, beside: Sequence[Effect] = ()) -> Evidence:
        """What each candidate explains of this fit's residual. trials: compare it with noise. beside: effects that take
        their part of it first.
        """
        space = self.space_of(fit)
        signs = np.ones((1, len(self.drivers)))
        if trials:
            drawn = np.random.default_rng(0).choice([-1.0, 1.0], (_TRIALS, self.unit.max() + 1))
            signs = np.concatenate([signs, drawn[:, self.unit]])
        more = space.spanned([self.rows_of(space, effect) for effect in beside])
        left = space.signed(signs, more)
        for directions in (more, left) if beside else (left,):
            directions.against.update(directions.contract(self._columns(self._keys, space)))
        freedom = space.freedom - more.Q.shape[2]
        total = np.sum(left.Q**2, axis=(0, 1)) + 1e-300
        share, score, best = [np.zeros(0)], [np.zeros(0)], np.zeros(len(signs))
        for bank, (gram, own) in zip(self.banks, self._grams(space), strict=True):
            taken = squared(bank.sums(more.against)) if beside else 0.0
            inverse, sizes = inverses(gram - taken, own)
            shares = explained(inverse, bank.sums(left.against)) / total
            share.append(shares[:, 0])
            score.append(np.zeros(len(shares)))
            for m in np.unique(sizes).tolist():
                if (table := score_table(int(m), freedom)) is not None:
                    here = sizes == m
                    score[-1][here] = np.interp(shares[here, 0], *table)
                    # more explained is a better score: of candidates alike in size only the best in a trial is asked
                    best = np.maximum(best, np.interp(shares[here].max(axis=0), *table))
        return Evidence(self.effects, np.concatenate(share), np.concatenate(score), freedom, self.complexity, best[1:])

    def enough(self, fit: Fit, least: int = MIN_FREEDOM) -> bool:
        """Whether the samples leave rows enough beyond what is fitted to say anything."""
        return self.space_of(fit).freedom >= least

    def amplitudes(self, fit: Fit, effect: Effect) -> Array:
        """The amplitudes with which an effect explains most of this fit's residual, (m,)."""
        return self.together(fit, (effect,))[0]

    def together(self, fit: Fit, effects: Sequence[Effect]) -> tuple[Array, float]:
        """What several effects explain most of this fit's residual with: the amplitudes of the last (m,), and the share
        of them all.
        """
        space = self.space_of(fit)
        each = [self.rows_of(space, effect) for effect in effects]
        rows = np.concatenate(each)
        gram, n = space.products(rows), rows @ space.residual.ravel()
        own = np.diag(gram)
        scale = np.where(own > 1e-12 * own.max(initial=1e-300), np.sqrt(np.abs(own)), np.inf)  # no sample, no amplitude
        amplitudes = np.linalg.lstsq(gram / np.outer(scale, scale), n / scale, rcond=1e-4)[0] / scale
        return amplitudes[-len(each[-1]) :], float(n @ amplitudes) / space.total

    def rows_of(self, space: Space, effect: Effect) -> Array:
        """An effect's columns in the rows of a fit, (m, 6 N)."""
        keys, numbers = self._factor(effect)
        rows = [self._column(key, space) * x for key, x in zip(keys, numbers, strict=True)]
        return np.reshape(rows, (len(rows), -1))

    def _column(self, key: Key, space: Space) -> Array:
        if key not in space.columns:
            parts = self._composed.get(key) or [(key[0], int(key[1]), 1.0)]  # type: ignore[call-overload]
            space.columns[key] = np.sum([space.column(k, d) * share for k, d, share in parts], axis=0)
        return space.columns[key]

    def _columns(self, keys: Iterable[Key], space: Space) -> dict[Key, Array]:
        """Unit columns (6, N) of places and directions."""
        return {key: self._column(key, space) for key in keys}

    def _grams(self, space: Space) -> list[tuple[Array, Array]]:
        """For each bank products of each candidate's columns with each other (C, m, m), the fitted projected out, and
        their squares before that, (C, m).
        """
        if not space.grams:
            columns, fitted = self._columns(self._keys, space), space.fitted
            fitted.against.update(fitted.contract(columns))
            for bank in self.banks:
                gram = bank.gram(columns)
                along = squared(bank.sums(fitted.against))
                space.grams.append((gram - along, np.einsum("cii->ci", gram).copy()))
        return space.grams


def inverses(gram: Array, own: Array) -> tuple[Array, np.ndarray]:
    """Inverses (C, m, m) of products of columns with each other, and how many directions are new, (C,).

    own: squares of the columns (C, m). Directions that the fit can nearly make by itself are left out.
    """
    least = np.maximum(_ROUNDING * own.max(axis=1, keepdims=True), _NO_SQUARE)
    scale = np.where(own > least, 1.0 / np.sqrt(np.maximum(own, least)), 0.0)
    scaled = gram * scale[:, :, None] * scale[:, None, :]
    # Where all directions are new, which is most often, there is nothing to take apart: the least eigenvalue is no less
    # than one over the size of the inverse.
    m = gram.shape[1]
    out = np.asarray(np.linalg.inv(scaled + _ONLY_ROUNDING * np.eye(m)), dtype=float)
    rest = np.flatnonzero(~(np.einsum("cij,cij->c", out, out) < _MIN_NEW**-2))
    sizes = np.full(len(scaled), m)
    value, vector = np.linalg.eigh(scaled[rest])
    keep = value > _MIN_NEW
    part = np.where(keep, 1.0 / np.maximum(value, _MIN_NEW), 0.0)[:, None]
    out[rest], sizes[rest] = (vector * part) @ vector.transpose(0, 2, 1), keep.sum(axis=1)
    return out * scale[:, :, None] * scale[:, None, :], sizes


def explained(inverse: Array, n: Array) -> Array:
    """``nᵀ inverse n`` of each candidate and trial, (C, trials): inverse (C, m, m), n (C, m, trials)."""
    return np.asarray(np.einsum("cmf,cmf->cf", inverse @ n, n))


@lru_cache(maxsize=256)
def score_table(m: int, freedom: int) -> tuple[Array, Array] | None:
    """Shares, and −log10 of the chance that white noise gives a candidate of m new directions one as large.

    None where there is nothing to explain, or nothing left to compare with.
    """
    if not 0 < m < freedom - 1:
        return None
    grid = np.concatenate([np.linspace(0.0, 0.9, 400), 1.0 - np.geomspace(0.1, 1e-9, 300)])
    ratio = grid / m / ((1.0 - grid) / (freedom - m))
    table = -log10_beyond_f(ratio, m, freedom - m)
    # far out the tail underflows; there it is a power of what is left
    bad = ~np.isfinite(table)
    if bad.any():
        last = int(np.argmax(bad)) - 1
        table[bad] = table[last] + 0.5 * (freedom - m) * np.log10((1.0 - grid[last]) / (1.0 - grid[bad]))
    return grid, table


def _gathered(banks: Sequence[Bank]) -> Iterator[Bank]:
    """Banks in their order; neighbours of any numbers, alike in width, made one."""
    for (_, numbers), some in groupby(banks, lambda bank: (bank.width, isinstance(bank, NumberBank))):
        if numbers:
            yield GatheredBank([bank for bank in some if isinstance(bank, NumberBank)])
        else:
            yield from some


def _cycles(alike: list[Effect]) -> Array:
    return np.array([e.shape.settings["cycles"] for e in alike])


def _highest(alike: list[Effect]) -> float:
    """The most cycles a turn of any wave of periodic effects."""
    several = len(alike) > 1 and alike[0].shape.kind in PERIODIC
    return float(_cycles(alike).max() * _multiples(alike[0]).max()) if several else 0.0


def _multiples(effect: Effect) -> np.ndarray:
    """What times its cycles the waves of a periodic effect have."""
    return np.arange(1, effect.shape.size // 2 + 1)


def _alike(effects: Sequence[Effect]) -> list[list[Effect]]:
    """The effects in lists: those that differ in their cycles alone are set up at once.

    Nine in ten candidates are of that kind.
    """
    lists: dict[object, list[Effect]] = {}
    for i, effect in enumerate(effects):
        kind = effect.shape.kind
        repeats = kind in PERIODIC and effect.direction == AXIS
        key = (effect.place, effect.direction, effect.driver, kind) if repeats else i
        lists.setdefault(key, []).append(effect)
    return list(lists.values())

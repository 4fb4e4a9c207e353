"""How much each candidate effect would explain of what a fit leaves over, and how much pure noise would.

A candidate's columns are the derivatives of the readings with respect to its amplitudes. What the fitted parameters
could still explain is projected out of residual and candidates, so nothing is found that they could have taken up.

Noise is not white in a tracker's frame: a joint that does not repeat throws the tool along its own columns. What can be
relied on is that stations are independent and their noise is as likely to point one way as the other. So the residual
vectors of whole stations are given random signs, everything is scanned again, and the best candidate found in such a
recording of pure noise is noted (wild bootstrap; Wu 1986, Liu 1988). Those maxima follow an extreme-value law (Gumbel),
which gives the chance that noise makes a best as good as the real one, all candidates looked at included.

Every candidate is a direction at a place times numbers, one a sample. So each (place, direction) is contracted with the
residual and with the projector once, and the thousands of candidates that share it cost sums with their numbers
(:mod:`banks`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise

import numpy as np

from modcal_core.calibration.identify import Fit
from modcal_core.calibration.runs import independent_unit
from modcal_core.diagnosis.anchor import Anchor
from modcal_core.diagnosis.banks import Bank, SpectraOfDrivers, StepBank, WaveBank, wave_step
from modcal_core.diagnosis.chance import FIRST_FLIPS, FLIPS, against_noise, is_clear, score_table
from modcal_core.diagnosis.explained import explained, inverses
from modcal_core.diagnosis.known_sums import Key, Parts
from modcal_core.diagnosis.number_banks import GatheredBank, NumberBank, NumberPool, gathered
from modcal_core.diagnosis.space import Directions, SignTrials, Space
from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import AXIS, LENGTH, STEPS, Effect, columns, place_index
from modcal_core.effects.family import USUAL
from modcal_core.effects.registry import complexity
from modcal_core.effects.shapes import PERIODIC, periodic
from modcal_core.geometry.so3 import Array

MIN_FREEDOM = 20  # rows beyond what is fitted
_KEPT = 2  # fits whose rows are kept beside those of the last: a look ahead, and back
_AT_ONCE = 10_000  # candidates times trials; what they explain then stays near the processor


@dataclass(frozen=True)
class Evidence:
    """What C candidates explain. effects: the candidates. explained: share of the residual's squares, (C,). score: how
    unlikely that share would be of white noise, −log10 p, (C,). p_value: that pure noise would have as good a best.
    inflation: how much larger scores of this noise are than those of white noise. freedom: rows beyond what is fitted.
    flips: trials that p_value was compared with. complexity: how much it takes to believe each, (C,). noise: the best
    score in each trial, (flips,).
    """

    effects: tuple[Effect, ...]
    explained: Array
    score: Array
    p_value: float
    inflation: float
    freedom: int
    flips: int
    complexity: np.ndarray
    noise: Array


@dataclass(frozen=True)
class _Weighed:
    """What the C candidates of some banks, of m columns each, are in the rows of a fit. inverse: of the products of
    their columns, the fitted projected out, (C, m, m). sizes: numbers of new directions, (C,).
    """

    banks: tuple[Bank, ...]
    inverse: Array
    sizes: np.ndarray


_Tables = Mapping[int, tuple[Array, Array] | None]


class Scanner:
    """Candidates at certain samples, set up once and weighed against the residual of any fit."""

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
        self._seen: list[tuple[Fit, Space]] = []
        self._anchor: Anchor | None = None
        self._scanned: tuple[list[_Weighed], _Tables] = [], {}  # of the last scan with trials

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

    def space_of(self, fit: Fit) -> Space:
        """The rows of this fit at the samples."""
        for known, space in self._seen:
            if known is fit:
                return space
        found = None if self._anchor is None else self._anchor.beside(fit, self.drivers)
        if found is None:
            self._seen.clear()  # they hold what is of the anchor
            self._anchor = Anchor.of(fit, self.drivers)
            found = self._anchor.space
        self._seen = [*self._seen[-_KEPT:], (fit, found)]
        return found

    def evidence(
        self, fit: Fit, rng: np.random.Generator | None = None, flips: int = FLIPS, most: int | None = None
    ) -> Evidence:
        """What each candidate explains of this fit's residual; without rng nothing is said of noise (p_value 1).

        most: banks of nothing but candidates of greater complexity are left out, which explain nothing then.
        """
        space = self.space_of(fit)
        signs = np.ones((1, self.unit.max() + 1))
        if rng is not None:
            signs = np.concatenate([signs, rng.choice([-1.0, 1.0], (flips, self.unit.max() + 1))])
        asked = [bank for bank in self.banks if most is None or self._plainest(bank) <= most]
        weighed = [self._weighed(tuple(alike), space) for _, alike in groupby(asked, lambda bank: bank.width)]
        size = np.concatenate([part.sizes for part in weighed])
        tables = {int(m): score_table(int(m), space.freedom) for m in np.unique(size)}
        if rng is not None:
            self._scanned = weighed, tables
        whole = space.trials(signs[:1][:, self.unit])
        squares, best = self._explained(weighed, space, whole, tables)
        for some in (signs[1 : 1 + FIRST_FLIPS], signs[1 + FIRST_FLIPS :]):
            if len(some) and (len(best) == 1 or not is_clear(best)):
                trials = space.lean_trials(some[:, self.unit])
                best = np.concatenate([best, self._explained(weighed, space, trials, tables)[1]])
        if most is not None:
            taken = np.concatenate([np.full(len(b.effects), self._plainest(b) <= most) for b in self.banks])
            size, squares = _spread(size, taken), _spread(squares, taken)
        share = squares / whole.total[0]
        score = _scores(share, size, tables)
        p_value, inflation = against_noise(best, len(self.effects))
        noise = best[1:]
        return Evidence(
            self.effects, share, score, p_value, inflation, space.freedom, len(noise), self.complexity, noise
        )

    def beyond(self, ahead: Fit, scan: Evidence) -> Evidence:
        """What candidates explain, at least, of what is left beside more effects than the last scan with trials knew.

        ahead: that scan's fit with these effects. scan: its evidence, whose trials say what noise would do: scores are
        of shares, whatever is left. What the new effects have in common with a candidate is not taken from the
        candidate's squares, so that its share is too small rather than too large.
        """
        weighed, tables = self._scanned
        trial = self.space_of(ahead).trials(np.ones((1, len(self.drivers))))
        squares, best = self._explained(weighed, self.space_of(ahead), trial, tables)
        share = squares / trial.total[0]
        score = _scores(share, np.concatenate([part.sizes for part in weighed]), tables)
        p_value = against_noise(np.r_[best, scan.noise], len(self.effects))[0]
        return replace(scan, explained=share, score=score, p_value=p_value)

    def _plainest(self, bank: Bank) -> int:
        """The least complexity among the candidates of a bank."""
        return self._least[id(bank)]

    def enough(self, fit: Fit, least: int = MIN_FREEDOM) -> bool:
        """Whether the samples leave rows enough beyond what is fitted to say anything."""
        return self.space_of(fit).freedom >= least

    def amplitudes(self, fit: Fit, effect: Effect) -> Array:
        """The amplitudes with which an effect explains most of this fit's residual, (m,)."""
        keys, numbers = self._factor(effect)
        space = self.space_of(fit)
        bank = NumberBank((effect,), keys, numbers[None])
        gram, _ = self._gram(bank, space)
        n = self._products(bank, space, space.trials(np.ones((1, len(self.drivers)))))
        own = np.einsum("cii->ci", gram)[0]
        scale = np.where(own > 1e-12 * own.max(initial=1e-300), np.sqrt(np.abs(own)), np.inf)  # no sample, no amplitude
        solution = np.linalg.lstsq(gram[0] / np.outer(scale, scale), n[0, :, 0] / scale, rcond=1e-4)[0]
        return np.asarray(solution / scale)

    def _factor(self, effect: Effect) -> tuple[tuple[Key, ...], Array]:
        """The directions at places of an effect's columns, and their numbers (m, N)."""
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
            own = f" {i} {sorted(effect.shape.settings.items())}" if len(terms) > 1 else ""
            keys.append((several[0].place, effect.direction + effect.driver + own))
            self._composed[keys[-1]] = [(t.place, t.direction, t.size) for t in several]
        return tuple(keys), np.ones((len(keys), len(self.drivers)))

    def _column(self, key: Key, space: Space) -> Array:
        if key not in space.columns:
            parts = self._composed.get(key) or [(key[0], int(key[1]), 1.0)]  # type: ignore[call-overload]
            space.columns[key] = np.sum([space.column(k, d) * share for k, d, share in parts], axis=0)
        return space.columns[key]

    def _columns(self, keys: Iterable[Key], space: Space) -> dict[Key, Array]:
        """Unit columns (6, N) of places and directions."""
        return {key: self._column(key, space) for key in keys}

    def _weighed(self, banks: tuple[Bank, ...], space: Space) -> _Weighed:
        grams, squares = zip(*(self._gram(bank, space) for bank in banks), strict=True)
        return _Weighed(banks, *inverses(np.concatenate(grams), np.concatenate(squares)))

    def _explained(
        self, weighed: Sequence[_Weighed], space: Space, trials: SignTrials, tables: _Tables
    ) -> tuple[Array, Array]:
        """The squares of the first trial that each candidate explains (C,), and the best score in each, (trials,)."""
        squares = []
        most = {m: np.zeros(len(trials.total)) for m, table in tables.items() if table is not None}
        for part in weighed:
            done = 0
            for products in self._in_portions(part.banks, space, trials):
                rows = slice(done, done + len(products))
                done += len(products)
                of_trials = explained(part.inverse[rows].astype(products.dtype, copy=False), products)
                squares.append(of_trials[:, 0])
                sizes = part.sizes[rows]
                for m in set(sizes.tolist()) & most.keys():
                    np.maximum(most[m], of_trials[sizes == m].max(axis=0), out=most[m])
        # more explained is a better score: of candidates alike in size only the best in a trial is asked for
        scores = [np.interp(so_far / trials.total, *tables[m]) for m, so_far in most.items()]  # type: ignore[misc]
        return np.concatenate(squares), np.max(scores, axis=0, initial=0.0)

    def _in_portions(self, banks: Sequence[Bank], space: Space, trials: SignTrials) -> Iterator[Array]:
        """Products of all candidates of these banks with the trials (C, m, trials), some hundred at once."""
        at_once = max(_AT_ONCE // len(trials.total), 1)
        waiting: list[Array] = []
        for bank in banks:
            for first in range(0, len(bank.effects), at_once):
                waiting.append(self._products(bank, space, trials, slice(first, first + at_once)))
                if sum(map(len, waiting)) >= at_once:
                    yield waiting[0] if len(waiting) == 1 else np.concatenate(waiting)
                    waiting = []
        if waiting:
            yield np.concatenate(waiting)

    def _products(self, bank: Bank, space: Space, trials: SignTrials, rows: slice = slice(None)) -> Array:
        """Products with the trials (C, m, trials) of some of its candidates, the fitted projected out."""
        if missing := self._missing(bank, trials.known):
            trials.known.update(trials.seen_by(self._columns(missing, space)))
        return bank.sums(trials.known, trials.sums, rows)

    def _gram(self, bank: Bank, space: Space) -> tuple[Array, Array]:
        """Products of each candidate's columns with each other (C, m, m), the fitted projected out, and their squares
        before that, (C, m).
        """
        if not self._is_own(bank):
            gram = bank.gram(self._columns(bank.keys, space))
            parts = [part.sign * self._along(bank, space, part) for part in space.parts]
            return gram - sum(parts), np.einsum("cii->ci", gram).copy()
        number = id(bank)
        if number not in space.squares:
            space.squares[number] = bank.gram(self._columns(bank.keys, space))
        gram = space.squares[number]
        left = gram.copy()
        for part in space.parts:
            if number not in part.grams:
                part.grams[number] = self._along(bank, space, part)
            left -= part.sign * part.grams[number]
        return left, np.einsum("cii->ci", gram).copy()

    def _is_own(self, bank: Bank) -> bool:
        """Whether it is one of the scanner's banks, which stay as long as it does."""
        return id(bank) in self._least

    def _along(self, bank: Bank, space: Space, part: Directions) -> Array:
        """Products with each other of what of each candidate's columns lies along these directions, (C, m, m)."""
        if missing := self._missing(bank, part.against):
            part.against.update(part.contract(self._columns(missing, space)))
        return bank.gram_of_sums(part.against, part.sums)

    def _missing(self, bank: Bank, known: Mapping[Key, Array]) -> list[Key]:
        """Keys whose contraction is to be computed for this bank, and those of all others with it: what there is to
        read is then read once.
        """
        return [key for key in (self._keys if self._is_own(bank) else bank.keys) if key not in known]


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


def _scores(share: Array, size: np.ndarray, tables: _Tables) -> Array:
    """How unlikely shares (C,) would be of white noise, −log10 p. size: numbers of new directions, (C,)."""
    score = np.zeros(len(share))
    for m, table in tables.items():
        if table is not None:
            score[size == m] = np.interp(share[size == m], *table)
    return score


def _spread(values: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Values at the places where something is true, zero elsewhere."""
    out = np.zeros(len(where), values.dtype)
    out[where] = values
    return out


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

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
from itertools import groupby

import numpy as np

from modcal_core.calibration import Fit
from modcal_core.diagnosis.anchor import Anchor
from modcal_core.diagnosis.banks import Bank, WaveBank
from modcal_core.diagnosis.candidate_banks import BankedCandidates
from modcal_core.diagnosis.explained import (
    FIRST_FLIPS,
    FLIPS,
    against_noise,
    explained,
    inverses,
    is_clear,
    score_table,
)
from modcal_core.diagnosis.number_banks import NumberBank
from modcal_core.diagnosis.space import Directions, SignTrials, Space, Weighed
from modcal_core.diagnosis.spectra import Key
from modcal_core.effects import USUAL, Drivers, Effect
from modcal_core.geometry import Array

MIN_FREEDOM = 20  # rows beyond what is fitted
_KEPT = 2  # fits whose rows are kept beside those of the last: a look ahead, and back
_AT_ONCE = 10_000  # candidates times trials; what they explain then stays near the processor


@dataclass(frozen=True)
class Evidence:
    """What C candidates explain. effects: the candidates. explained: share of the residual's squares, (C,). score: how
    unlikely that share would be of white noise, −log10 p, (C,). p_value: that pure noise would have as good a best.
    inflation: how much larger scores of this noise are than those of white noise. freedom: rows beyond what is fitted.
    flips: trials that p_value was compared with. complexity: how much it takes to believe each, (C,). noise: the best
    score in each trial, (flips,). space: the rows that they were weighed in.
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
    space: Space


@dataclass(frozen=True)
class _Group:
    """Banks of as many columns each. plain: whether any of their candidates is no free shape. waves: whether they are
    waves of joints. rows: of their candidates among all.
    """

    banks: tuple[Bank, ...]
    plain: bool
    waves: bool
    rows: slice


_Tables = Mapping[int, tuple[Array, Array] | None]


class Scanner(BankedCandidates):
    """Candidates at certain samples, set up once and weighed against the residual of any fit."""

    def __init__(self, effects: Sequence[Effect], drivers: Drivers) -> None:
        """effects: the candidates. drivers: at the samples they are looked for on."""
        super().__init__(effects, drivers)
        self._seen: list[tuple[Fit, Space]] = []
        self._anchor: Anchor | None = None
        self._groups: list[_Group] = []
        done = 0
        for (_, plain, waves), some in groupby(self.banks, self._kind):
            banks = tuple(some)
            first, done = done, done + sum(len(bank.effects) for bank in banks)
            self._groups.append(_Group(banks, plain, waves, slice(first, done)))

    def _kind(self, bank: Bank) -> tuple[int, bool, bool]:
        """What banks of a group share: columns, whether some candidate is no free shape, whether they are waves."""
        return bank.width, self._plainest(bank) <= USUAL, isinstance(bank, WaveBank)

    def space_of(self, fit: Fit) -> Space:
        """The rows of this fit at the samples."""
        for i, (known, space) in enumerate(self._seen):
            if known is fit:
                self._seen.append(self._seen.pop(i))
                return space
        found = None if self._anchor is None else self._anchor.beside(fit, self.drivers)
        if found is None:
            self._seen.clear()  # they hold what is of the anchor
            self._anchor = Anchor.of(fit, self.drivers)
            found = self._anchor.space
        self._seen = [*self._seen[-_KEPT:], (fit, found)]
        return found

    def evidence(
        self, fit: Fit, rng: np.random.Generator | None = None, flips: int = FLIPS, plain: bool = False
    ) -> Evidence:
        """What each candidate explains of this fit's residual; without rng nothing is said of noise (p_value 1).

        plain: banks of nothing but free shapes are left out, which explain nothing then.
        """
        space = self.space_of(fit)
        asked = self._asked(plain)
        tables = self._tables(asked, space, space.freedom)
        whole = space.unsigned
        squares, best = self._explained(asked, space, space, whole, tables)
        if rng is not None:
            signs = rng.choice([-1.0, 1.0], (flips, self.unit.max() + 1))
            for some in (signs[:FIRST_FLIPS], signs[FIRST_FLIPS:]):
                if len(some) and (len(best) == 1 or not is_clear(best)):
                    trials = space.trials(some[:, self.unit])
                    best = np.concatenate([best, self._explained(asked, space, space, trials, tables)[1]])
        share = squares / whole.total[0]
        p_value, inflation = against_noise(best, len(self.effects))
        return Evidence(
            effects=self.effects,
            explained=share,
            score=self._scores(asked, space, share, tables),
            p_value=p_value,
            inflation=inflation,
            freedom=space.freedom,
            flips=len(best) - 1,
            complexity=self.complexity,
            noise=best[1:],
            space=space,
        )

    def beyond(self, ahead: Fit, scan: Evidence, plain: bool = False) -> Evidence:
        """What candidates explain, at least, of what is left beside more effects than a scan knew.

        ahead: that scan's fit with these effects. scan: its evidence, whose trials say what noise would do: scores are
        of shares, whatever is left. plain: as for evidence. What the new effects have in common with a candidate is not
        taken from the candidate's squares, so that its share is too small rather than too large.
        """
        asked = self._asked(plain)
        tables = self._tables(asked, scan.space, scan.space.freedom)
        space = self.space_of(ahead)
        squares, best = self._explained(asked, scan.space, space, space.unsigned, tables)
        share = squares / space.unsigned.total[0]
        score = self._scores(asked, scan.space, share, tables)
        p_value = against_noise(np.r_[best, scan.noise], len(self.effects))[0]
        return replace(scan, explained=share, score=score, p_value=p_value)

    def at_most(self, fit: Fit, beside: Fit) -> tuple[Array, np.ndarray] | None:
        """Upper bounds of the scores (C,) of this fit's residual with waves unrestricted, and which are exact (C,).
        None where a direction of a wave is already explained by ``beside``.

        beside: the fit with one effect more. Free shapes score nothing.
        """
        asked, wider = self._asked(plain=True), self.space_of(beside)
        waves = [i for i in asked if self._groups[i].waves]
        if any((known.sizes < known.inverse.shape[1]).any() for known in (self._weighed(i, wider) for i in waves)):
            return None
        space = self.space_of(fit)
        score, exact = np.zeros(len(self.effects)), np.ones(len(self.effects), bool)
        for some, of in (([i for i in asked if i not in waves], space), (waves, wider)):
            tables = self._tables(some, of, space.freedom)
            squares, _ = self._explained(some, of, space, space.unsigned, tables)
            score += self._scores(some, of, squares / space.unsigned.total[0], tables)
        for i in waves:
            exact[self._groups[i].rows] = False
        return score, exact

    def enough(self, fit: Fit, least: int = MIN_FREEDOM) -> bool:
        """Whether the samples leave rows enough beyond what is fitted to say anything."""
        return self.space_of(fit).freedom >= least

    def amplitudes(self, fit: Fit, effect: Effect) -> Array:
        """The amplitudes with which an effect explains most of this fit's residual, (m,)."""
        return self.alone(fit, effect)[0]

    def alone(self, fit: Fit, effect: Effect) -> tuple[Array, float]:
        """The amplitudes with which an effect explains most of this fit's residual, (m,), and what share that is."""
        space = self.space_of(fit)
        if id(effect) not in space.alone:  # a choice is asked about more than once
            space.alone[id(effect)] = effect, *self._alone(space, effect)
        return space.alone[id(effect)][1:]

    def _alone(self, space: Space, effect: Effect) -> tuple[Array, float]:
        keys, numbers = self._factor(effect)
        bank = NumberBank((effect,), keys, numbers[None])
        gram, _ = self._gram(bank, space)
        n = self._products(bank, space, space.unsigned)[0, :, 0]
        own = np.einsum("cii->ci", gram)[0]
        scale = np.where(own > 1e-12 * own.max(initial=1e-300), np.sqrt(np.abs(own)), np.inf)  # no sample, no amplitude
        amplitudes = np.linalg.lstsq(gram[0] / np.outer(scale, scale), n / scale, rcond=1e-4)[0] / scale
        return np.asarray(amplitudes), float(n @ amplitudes) / float(space.unsigned.total[0])

    def _column(self, key: Key, space: Space) -> Array:
        if key not in space.columns:
            parts = self._composed.get(key) or [(key[0], int(key[1]), 1.0)]  # type: ignore[call-overload]
            space.columns[key] = np.sum([space.column(k, d) * share for k, d, share in parts], axis=0)
        return space.columns[key]

    def _columns(self, keys: Iterable[Key], space: Space) -> dict[Key, Array]:
        """Unit columns (6, N) of places and directions."""
        return {key: self._column(key, space) for key in keys}

    def _asked(self, plain: bool) -> list[int]:
        """The numbers of the groups that are asked: all, or those of which some are plain."""
        return [i for i, group in enumerate(self._groups) if group.plain or not plain]

    def _weighed(self, number: int, space: Space) -> Weighed:
        """What the candidates of a group are in the rows of a fit, computed once."""
        if number not in space.weighed:
            grams, squares = zip(*(self._gram(bank, space) for bank in self._groups[number].banks), strict=True)
            space.weighed[number] = Weighed(*inverses(np.concatenate(grams), np.concatenate(squares)))
        return space.weighed[number]

    def _tables(self, asked: Sequence[int], space: Space, freedom: int) -> _Tables:
        """Scores of shares for each number of new directions that candidates of these groups have."""
        sizes = {int(m) for i in asked for m in np.unique(self._weighed(i, space).sizes)}
        return {m: score_table(m, freedom) for m in sorted(sizes)}

    def _explained(
        self, asked: Sequence[int], of: Space, space: Space, trials: SignTrials, tables: _Tables
    ) -> tuple[Array, Array]:
        """The squares of the first trial that each candidate explains (C,), and the best score in each, (trials,).

        of: the rows that candidates are weighed in. space: those of the trials.
        """
        squares = np.zeros(len(self.effects))
        most = {m: np.zeros(len(trials.total)) for m, table in tables.items() if table is not None}
        for number in asked:
            group, weighed = self._groups[number], self._weighed(number, of)
            done = 0
            for products in self._in_portions(group.banks, space, trials):
                rows = slice(done, done + len(products))
                done += len(products)
                of_trials = explained(weighed.inverse[rows].astype(products.dtype, copy=False), products)
                squares[group.rows][rows] = of_trials[:, 0]
                sizes = weighed.sizes[rows]
                for m in set(sizes.tolist()) & most.keys():
                    alike = of_trials if weighed.even else of_trials[sizes == m]
                    np.maximum(most[m], alike.max(axis=0), out=most[m])
        # more explained is a better score: of candidates alike in size only the best in a trial is asked for
        scores = [np.interp(so_far / trials.total, *tables[m]) for m, so_far in most.items()]  # type: ignore[misc]
        return squares, np.max(scores, axis=0, initial=0.0)

    def _scores(self, asked: Sequence[int], space: Space, share: Array, tables: _Tables) -> Array:
        """How unlikely shares (C,) would be of white noise, −log10 p; of groups that are not asked nothing."""
        score = np.zeros(len(share))
        for number in asked:
            group, sizes = self._groups[number], self._weighed(number, space).sizes
            for m in set(sizes.tolist()):
                if (table := tables[m]) is not None:
                    here = sizes == m
                    score[group.rows][here] = np.interp(share[group.rows][here], *table)
        return score

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

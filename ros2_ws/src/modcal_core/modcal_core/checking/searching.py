"""Which change it was: one after the other, at most two, each only if the readings ask for it.

The change that is most probable is taken up, and what is left is asked again. A second change may show that the first
was mistaken for it, so the first is then chosen again beside the second. What explains the readings as well as what is
named, whether at these stations or everywhere, is named with it.

Who sets a cell up again moves the instrument and the target at once. So where two changes leave something, base and
tool are taken for moved, one of them or both, and up to two others are looked for beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from modcal_core.calibration import Model
from modcal_core.checking.changed_state import ChangedState, ChangedStates
from modcal_core.checking.evidence import SIZES, ChangeJudge, JudgedChange, e_value, is_noise, log_priors
from modcal_core.checking.hypotheses import BASE, NOISE, READING, TOOL, CellChange, hypotheses
from modcal_core.checking.noise import FrozenKnowledge
from modcal_core.checking.rivals import FittedChange, most_probable
from modcal_core.checking.rivals import with_rivals as fitted_with_rivals
from modcal_core.checking.sizes import SizeCovariance, with_sizes
from modcal_core.checking.state import CheckState
from modcal_core.checking.waves import wave_of
from modcal_core.effects import AS_LIKELY, put_back_first
from modcal_core.geometry import Array
from modcal_core.measurements import Samples

FALSE_ALARM = 0.01  # chance that something is named while nothing has changed, over all changes together
_BEAM = 5  # changes that a pair is begun with
_SET_UP = (BASE, TOOL)  # what is moved when a cell is set up again


class _Explained:
    """What explains readings. log_e: of what was found, and, last, of what is left."""

    log_e: tuple[float, ...]

    @property
    def more(self) -> bool:
        """Whether this does not explain all."""
        return _is_asked_for(self.log_e[-1])


@dataclass(frozen=True)
class FoundChanges(_Explained):
    """What a search found.

    model: with the changes put in. changes: at most two, beside what was moved when the cell was set up again. log_e:
    logarithms of the e-values by which each was asked for, and, last, of what is left. aside: samples that were set
    aside as wrong. samples: the others. start: the null before, on them. left: the one after. state: the model with the
    changes, beside them. sizes: what is known of these, those of what was given before them. opened: the null in which
    what was given is left open. asked: the changes that were looked for. given: those that were not asked for but
    given, as fitted.
    """

    model: Model
    changes: tuple[FittedChange, ...]
    log_e: tuple[float, ...]
    aside: tuple[int, ...]
    samples: Samples
    start: ChangeJudge
    left: ChangeJudge
    state: CheckState
    sizes: SizeCovariance
    opened: ChangeJudge
    asked: tuple[CellChange, ...]
    given: tuple[FittedChange, ...] = ()


def search(model: Model, samples: Samples, known: FrozenKnowledge, given: Sequence[CellChange] = ()) -> FoundChanges:
    """What has changed since the model was frozen, by these samples. given: changes that are known to be the case and
    whose sizes alone are asked for.
    """
    plain = _without_wrong(model, samples, known, tuple(given), ())
    best = plain
    moved = tuple(h for h in plain.by.asked if h.kind in _SET_UP) if plain.more else ()
    while moved:
        again = _without_wrong(model, samples, known, tuple(given), moved)
        asked_for = tuple(h for h in moved if again.asks_for(h))
        if len(asked_for) == len(moved):
            best = again if again.log_e[-1] < plain.log_e[-1] else plain
            break
        moved = asked_for
    return best.told()


@dataclass(frozen=True)
class _Picked(_Explained):
    """What a search picked. by: the search. changes: as judged. log_e: as of :class:`FoundChanges`. now: what stands
    with them taken up. aside: samples set aside as wrong.
    """

    by: _ChangeSearch
    changes: tuple[JudgedChange, ...]
    log_e: tuple[float, ...]
    now: ChangedState
    aside: tuple[int, ...] = ()

    @property
    def wrong(self) -> int:
        """The sample that is wrong; -1 where none is."""
        numbers = [c.candidate.hypothesis.sample for c in self.changes]
        return max(numbers, default=-1)

    def asks_for(self, moved: CellChange) -> bool:
        """Whether the readings ask for one of these changes beside all others."""
        beside = self.by.beside([c for c in self.changes if c.candidate.hypothesis.key != moved.key])
        judged, _ = beside.judge_all([moved], bent=True)
        prior = log_priors(self.by.asked)[next(i for i, h in enumerate(self.by.asked) if h.key == moved.key)]
        return _is_asked_for(self.by.weight * (judged[0].log_factor + float(prior)))

    def told(self) -> FoundChanges:
        """The same with what explains the readings as well, and with sizes."""
        by, state, left = self.by, self.now.state, self.now.judge
        given = [FittedChange(judged, 1.0, ()) for judged in by.fixed]
        if self.wrong >= 0:  # more readings are wrong than are set aside: sizes are not asked
            changes, sizes = [FittedChange(c, 1.0, ()) for c in self.changes], SizeCovariance.none(by.known)
        else:
            changes = [by.with_rivals(self.changes, i) for i in range(len(self.changes))]
            every, sizes = with_sizes([*given, *changes], self.now.fits, state, by.plain.judge.null, left.best)
            given, changes = every[: len(given)], every[len(given) :]
        return FoundChanges(
            state.model, tuple(changes), self.log_e, self.aside, by.samples, by.plain.judge, left, state, sizes,
            by.beside([]).judge, tuple(by.asked), tuple(given),
        )  # fmt: skip


def _without_wrong(
    model: Model, samples: Samples, known: FrozenKnowledge, given: tuple[CellChange, ...], moved: tuple[CellChange, ...]
) -> _Picked:
    """What is picked without the single readings that are wrong."""
    rows = np.arange(len(samples))
    aside: list[int] = []
    allowed = max(1, len(samples) // 10)
    while True:
        found = _ChangeSearch(model, samples.select(rows), known, given, moved).picked()
        if found.wrong < 0 or len(aside) >= allowed or len(rows) < 4:
            return replace(found, aside=tuple(aside))
        out = rows[found.wrong]
        aside.append(int(out))
        rows = rows[rows != out]


@dataclass(frozen=True)
class _ChangeSearch:
    """One search. given: changes that are the case. moved: those that are taken up first."""

    model: Model
    samples: Samples
    known: FrozenKnowledge
    given: tuple[CellChange, ...] = ()
    moved: tuple[CellChange, ...] = ()

    @cached_property
    def asked(self) -> list[CellChange]:
        """The changes that are looked for."""
        known = {h.key for h in self.given}
        every = [h for h in hypotheses(self.model, self.samples) if h.key not in known]
        if len(known) == len(self.model.frames):  # each stands where nobody knew it to stand: a base cannot move
            every = [h for h in every if h.kind != BASE]
        return every

    @cached_property
    def states(self) -> ChangedStates:
        """The frozen model with changes taken up."""
        return ChangedStates(CheckState(self.model, self.samples, self.known))

    @property
    def plain(self) -> ChangedState:
        """The frozen model beside the readings."""
        return self.states.plain

    @cached_property
    def fixed(self) -> list[JudgedChange]:
        """What is given, of any size."""
        return [replace(one, size=float(SIZES[-1])) for one in self.plain.judge_all(self.given)[0]]

    @property
    def weight(self) -> float:
        """Weight of what the stations say together, m/n: they count as m independent ones of n."""
        return self.plain.judge.null.weight

    def beside(self, picked: Sequence[JudgedChange]) -> ChangedState:
        """What stands with these changes taken up, on top of what is given."""
        return self.states.after([*self.fixed, *picked])

    def others(self, picked: Sequence[JudgedChange]) -> list[CellChange]:
        """What is looked for besides these changes."""
        known = _keys(picked)
        return [h for h in self.asked if h.key not in known]

    def taken(self, picked: Sequence[JudgedChange]) -> tuple[ChangedState, float]:
        """What stands with these changes taken up, and the e-value of what is left."""
        now = self.beside(picked)
        judged, prior = now.judge_all(self.others(picked))
        return now, e_value(judged, prior, self.weight)

    def picked(self) -> _Picked:
        """What explains the readings, or the first of them that is wrong."""
        moved = self.beside([]).judge_all(self.moved, bent=True)[0]
        now = self.beside(moved)
        judged, prior = now.judge_all(self.others(moved), bent=True)
        log_e = [e_value(judged, prior, self.weight)]
        picked = list(moved)
        if _is_asked_for(log_e[0]):
            first = most_probable(judged, prior, self.weight)
            if first.candidate.hypothesis.kind == READING:  # the caller sets it aside and begins again
                return _Picked(self, (first,), tuple(log_e), now)
            picked = [*moved, first]
            now, rest = self.taken(picked)
            log_e.append(rest)
            if _is_asked_for(rest) or is_noise(first):
                pair = self._best_pair(judged, prior, moved)
                alone = first.log_factor + float(prior[[j is first for j in judged]][0])
                if pair is not None and (_is_asked_for(rest) or _is_asked_for(self.weight * (pair[1] - alone))):
                    picked = [*moved, *pair[0]]
                    now, rest = self.taken(picked)
                    log_e = [log_e[0], self.weight * max(pair[1] - alone, 0.0), rest]
        for i, one in enumerate(picked):
            if one.candidate.free:
                others = [p for j, p in enumerate(picked) if j != i]
                beside = self.beside(others)
                curve, state = one.candidate.hypothesis.curve, beside.state
                wave = wave_of(curve, state.model, state.view, state.drivers, beside.judge)
                if wave is not None and wave.log_factor > one.log_factor:
                    picked[i] = wave
                    now, log_e[-1] = self.taken(picked)
        repaired = list(picked)
        for i in range(len(picked)):
            repaired[i] = self._outside(repaired, i)
        if any(a is not b for a, b in zip(repaired, picked, strict=True)):
            picked = self._needed(repaired, len(moved))
            now, rest = self.taken(picked)
            log_e = [*log_e[: len(picked) - len(moved)], rest]
        return _Picked(self, tuple(picked), tuple(log_e), now)

    def _needed(self, picked: list[JudgedChange], moved: int) -> list[JudgedChange]:
        """The changes without one that made up for what the arm was blamed for; the first ones are moved for sure."""
        for one in picked[moved:] if len(picked) > moved + 1 else []:
            others = [p for p in picked if p is not one]
            if not _is_asked_for(self.taken(others)[1]):
                return others
        return picked

    def _outside(self, picked: Sequence[JudgedChange], i: int) -> JudgedChange:
        """One of the changes that were picked, or what outside the arm explains the readings as well."""
        hypothesis, others = picked[i].candidate.hypothesis, [p for j, p in enumerate(picked) if j != i]
        if hypothesis.outside or hypothesis.kind in (NOISE, READING):
            return picked[i]
        asked = [h for h in self.others(others) if h.outside]
        every = self.beside(others).judge_all([*asked, hypothesis], bent=True)[0]
        likely = np.array([j.likelihood for j in every])
        outside = [True] * len(asked) + [False]
        first = put_back_first(len(asked), outside, likely, AS_LIKELY / self.weight)
        return picked[i] if first == len(asked) else every[first]

    def with_rivals(self, picked: Sequence[JudgedChange], i: int) -> FittedChange:
        """One of the changes that were picked, with what explains the readings as well."""
        one = picked[i]
        others = [p for j, p in enumerate(picked) if j != i]
        every, prior = self.beside(others).judge_all(self.others(others), bent=True)
        if not any(h is one.candidate.hypothesis for h in self.asked):  # a wave that was found by scanning
            own = [
                p
                for j, p in zip(every, prior, strict=True)
                if j.candidate.hypothesis.key == one.candidate.hypothesis.key
            ]
            every, prior = [*every, one], np.r_[prior, max(own)]
        return fitted_with_rivals(one, every, prior, self.weight)

    def _best_pair(
        self, judged: Sequence[JudgedChange], prior: Array, moved: Sequence[JudgedChange]
    ) -> tuple[list[JudgedChange], float] | None:
        """The two changes that are most probable together beside what was moved, and the logarithm of how much.

        One of them is among the few most probable alone; it is chosen again beside the other.
        """
        by_key: dict[tuple[str, str], tuple[float, JudgedChange]] = {}
        for j, p in zip(judged, prior, strict=True):
            value = j.log_factor + float(p)
            h = j.candidate.hypothesis
            if h.kind not in (READING, NOISE) and value > by_key.get(h.key, (-np.inf, j))[0]:
                by_key[h.key] = (value, j)
        tried = [first for _, first in sorted(by_key.values(), key=lambda pair: -pair[0])[:_BEAM]]
        before = self.beside(moved).judge.log_null
        best: tuple[list[JudgedChange], float] | None = None
        for first in tried:
            found = self._second(first, moved, before)
            if best is None or found[1] > best[1]:
                best = found
        if best is not None:  # the second may be the better beginning
            again = self._second(best[0][1], moved, before)
            best = max(best, again, key=lambda pair: pair[1])
        return best

    def _second(
        self, first: JudgedChange, moved: Sequence[JudgedChange], before: float
    ) -> tuple[list[JudgedChange], float]:
        """The most probable change beside a first one, and how probable both are together.

        before: logarithm of the probability of the readings without them.
        """
        beside = self.beside([*moved, first])
        judged, prior = beside.judge_all([h for h in self.others([*moved, first]) if h.kind != READING])
        value = np.array([j.log_factor for j in judged]) + prior
        at = int(np.argmax(value))
        own = log_priors(self.asked)[next(i for i, h in enumerate(self.asked) if h is first.candidate.hypothesis)]
        return [first, judged[at]], float(beside.judge.log_null - before + value[at] + own)


def _keys(judged: Sequence[JudgedChange]) -> set[tuple[str, str]]:
    return {j.candidate.hypothesis.key for j in judged}


def _is_asked_for(log_e: float) -> bool:
    """Whether the readings ask for a change by an e-value of this logarithm."""
    return bool(log_e > -np.log(FALSE_ALARM))

"""Which change it was: the most probable row is taken up, what is left is asked again, and no row stands needlessly.

A second change may show that the first was mistaken for it, so each is chosen again beside the others. Scatter looks
like any cause that was not found, so where it was taken up the search is made once more without it. Who sets a cell up
again moves the instrument and the target at once: where nothing explains the readings, the search begins with both.

What explains the readings as well is named with what is named, and what people put back by hand is taken first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy

from modcal_core.calibration import Model
from modcal_core.effects import AS_LIKELY, put_back_first
from modcal_core.effects.families import gear_harmonic
from modcal_core.geometry import Array
from modcal_core.measurements import Samples
from modcal_core.moves.likelihood import (
    SIZES,
    ChangeJudge,
    FrozenKnowledge,
    JudgedChange,
    NullModel,
    by_name,
    e_value,
    most_probable,
)
from modcal_core.moves.rows import (
    BASE,
    GEAR,
    KINDS,
    LIMIT,
    NOISE,
    READING,
    TOOL,
    CellChange,
    hypotheses,
    log_priors,
)
from modcal_core.moves.state import CheckState, along_one

FALSE_ALARM = 0.01  # chance that something is named while nothing has changed, over all changes together
_ASKED_FOR = -float(np.log(FALSE_ALARM))
_ROUNDS = 2  # in which each change is chosen again beside the others
_SET_UP = (BASE, TOOL)  # what is moved when a cell is set up again
AS_PROBABLE = 3.0  # in log-probability (20 to 1), within which two changes are not told apart
_SURE = 0.99  # probability that a wave has these cycles, within a cell or two of the scan
_NEAR = 1.6  # cells of the scan to either side that are one peak
_FINER = np.linspace(-1.0, 1.0, 81)  # of a cell, to which the cycles of a peak are found


@dataclass(frozen=True)
class FittedChange:
    """A change as it is named. judged: what speaks for it. probability: that it is this one of all. same_as: others
    that explain the same. sizes: [m, rad, 1], with their covariance.
    """

    judged: JudgedChange
    probability: float
    same_as: tuple[JudgedChange, ...] = ()
    sizes: Array = field(default_factory=lambda: np.empty(0))
    covariance: Array = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def hypothesis(self) -> CellChange:
        """What changed."""
        return self.judged.hypothesis


@dataclass(frozen=True)
class FoundChanges:
    """What a search found.

    changes: as named. given: those that were not asked for but given, as fitted. covariance: of the sizes of given and
    changes together, (k, k). log_e: logarithms of the e-values by which each was asked for, and, last, of what is left.
    aside: samples that were set aside as wrong, with what stands at its limit there. plain, state: the frozen
    model beside the others, and with the changes taken up. asked: what was looked for.
    """

    changes: tuple[FittedChange, ...]
    given: tuple[FittedChange, ...]
    covariance: Array
    log_e: tuple[float, ...]
    aside: Mapping[int, str]
    plain: CheckState
    state: CheckState
    asked: tuple[CellChange, ...]

    @property
    def samples(self) -> Samples:
        """Those that were not set aside."""
        return self.state.samples

    @property
    def more(self) -> bool:
        """Whether this does not explain all."""
        return self.log_e[-1] > _ASKED_FOR


def search(model: Model, samples: Samples, known: FrozenKnowledge, given: Sequence[CellChange] = ()) -> FoundChanges:
    """What has changed since the model was frozen, by these samples. given: changes that are known to be the case and
    whose sizes alone are asked for.
    """
    rows = np.arange(len(samples))
    aside: dict[int, str] = {}
    while True:
        engine = MoveSearch(CheckState(model, samples.select(rows), known), tuple(given))
        found = engine.best()
        wrong = next((c.hypothesis for c in found.picked if c.hypothesis.wrong), None)
        most = max(1, len(samples) // 10) if wrong is None or wrong.kind == READING else len(samples) // 2 + 1
        if wrong is None or len(aside) >= most or len(rows) < 4:
            return engine.told(found, aside)
        aside |= {int(rows[i]): wrong.label if wrong.kind == LIMIT else "" for i in wrong.wrong}
        rows = np.setdiff1d(np.arange(len(samples)), [*aside])


@dataclass(frozen=True)
class Explanation:
    """picked: changes as judged. log_e: as of :class:`FoundChanges`. score: logarithm of the probability of the
    readings and the names together, over that of none.
    """

    picked: tuple[JudgedChange, ...]
    log_e: tuple[float, ...]
    score: float

    @property
    def more(self) -> bool:
        """Whether this does not explain all."""
        return self.log_e[-1] > _ASKED_FOR


class MoveSearch:
    """One search beside a frozen model.

    given: changes that are the case. asked: rows to ask of; None: all. asked_for: log e-value [nats] above which one
    more is taken up. most: changes beside what was moved when the cell was set up again.
    """

    def __init__(
        self,
        plain: CheckState,
        given: Sequence[CellChange] = (),
        asked: Sequence[CellChange] | None = None,
        asked_for: float = _ASKED_FOR,
        most: int = 2,
    ) -> None:
        self.plain = plain
        self.given, self.weight, self.asked_for, self.most = given, plain.null.weight, asked_for, most
        self._taken: dict[tuple[int, ...], tuple[list[JudgedChange], CheckState]] = {}
        keys = {h.key for h in given}
        table = hypotheses(plain.model, plain.samples) if asked is None else asked
        every = [h for h in table if h.key not in keys]
        # where each frame stands where nobody knew it to stand, a base cannot move
        self.asked = [h for h in every if h.kind != BASE] if len(keys) == len(np.unique(plain.samples.frame)) else every

    @cached_property
    def fixed(self) -> list[JudgedChange]:
        """What is given, of any size."""
        return [replace(one, size=float(SIZES[-1])) for one in self.plain.judge_all(self.given)[0]]

    def beside(self, picked: Sequence[JudgedChange]) -> CheckState:
        """What stands with these changes taken up, on top of what is given."""
        key = tuple(map(id, picked))
        if key not in self._taken:
            self._taken[key] = list(picked), self.plain.with_these([*self.fixed, *picked])
        return self._taken[key][1]

    def others(self, picked: Sequence[JudgedChange], without: Sequence[str] = ()) -> list[CellChange]:
        """What is looked for besides these changes."""
        known = {j.hypothesis.key for j in picked}
        return [h for h in self.asked if h.key not in known and h.kind not in without]

    def left(self, picked: Sequence[JudgedChange]) -> float:
        """The e-value of what is left beside these changes."""
        return e_value(*self.beside(picked).judge_all(self.others(picked)), weight=self.weight)

    def best(self) -> Explanation:
        """The most probable explanation, or the first reading that is wrong."""
        ways = self._weighed()
        if ways and ways[0].picked and ways[0].picked[0].hypothesis.wrong:  # set aside before anything is blamed
            return ways[0]
        if not ways or any(c.is_noise for c in ways[0].picked):
            ways += self._weighed(without=(NOISE,))
            if ways and ways[-1].picked and ways[-1].picked[0].hypothesis.kind == LIMIT:
                return ways[-1]
        if all(way.more for way in ways) and (moved := [h for h in self.asked if h.kind in _SET_UP]):
            ways += self._weighed(moved)
        if not ways:
            raise np.linalg.LinAlgError("the readings are too far away to weigh what explains them")
        found = max(ways, key=lambda way: (not way.more, way.score))
        if any(c.hypothesis.wrong for c in found.picked):
            return found
        picked = self.needed([self._wave(found.picked, i) for i in range(len(found.picked))])
        for i in range(len(picked)):
            picked[i] = self._outside(picked, i)
        picked = self.needed(picked)  # what made up for a wrong name is needless
        asked_for = (*ways[0].log_e[:1], *found.log_e[1 : len(picked)]) if picked else ()  # the first beside nothing
        return Explanation(tuple(picked), (*asked_for, self.left(picked)), found.score)

    def _weighed(self, begin: Sequence[CellChange] = (), without: Sequence[str] = ()) -> list[Explanation]:
        """The explanation; none where changes are so far off that they cannot be weighed."""
        try:
            return [self.explained(begin, without)]
        except np.linalg.LinAlgError:
            return []

    def explained(self, begin: Sequence[CellChange] = (), without: Sequence[str] = ()) -> Explanation:
        """Changes taken up one after the other, until no more is asked for. begin: that are taken up first."""
        picked = self.beside([]).judge_all(begin, bent=True)[0]
        log_e: list[float] = []
        while True:
            now = self.beside(picked)
            judged, prior = now.judge_all(self.others(picked, without), bent=True)
            log_e.append(e_value(judged, prior, self.weight))
            if log_e[-1] <= self.asked_for or len(picked) >= len(begin) + self.most:
                return Explanation(tuple(picked), tuple(log_e), self._score(picked))
            one = most_probable(judged, prior, self.weight)
            if one.hypothesis.wrong:  # it is set aside, and the search begins again
                return Explanation((*picked, one), tuple(log_e), np.inf)
            picked = self._chosen_again([*picked, one], len(begin), without)

    def _chosen_again(self, picked: list[JudgedChange], fixed: int, without: Sequence[str]) -> list[JudgedChange]:
        """Each change but the first ones as it is most probable beside the others."""
        for _ in range(_ROUNDS if len(picked) > fixed + 1 else 0):
            before = list(picked)
            for i in range(fixed, len(picked)):
                rest = [c for j, c in enumerate(picked) if j != i]
                judged, prior = self.beside(rest).judge_all(self.others(rest, (READING, LIMIT, *without)), bent=True)
                best = most_probable(judged, prior, self.weight)
                if best.hypothesis.key != picked[i].hypothesis.key:
                    picked[i] = best
            if picked == before:
                break
        return picked

    def _score(self, picked: Sequence[JudgedChange]) -> float:
        order = sorted(picked, key=lambda c: c.is_noise)  # scatter has no size that could be left open
        if not order:
            return 0.0
        rest = self.beside(order[:-1])
        last = rest.judge_all([order[-1].hypothesis], bent=True)[0][0]
        price = sum(self._price(c.hypothesis) for c in order)
        return self.weight * (rest.judge.log_null - self.beside([]).judge.log_null + last.log_factor) + price

    def _price(self, hypothesis: CellChange) -> float:
        """Logarithm of the chance of meeting this change."""
        at = next(i for i, h in enumerate(self.asked) if h.key == hypothesis.key)
        return float(log_priors(self.asked)[at])

    def needed(self, picked: list[JudgedChange]) -> list[JudgedChange]:
        """The changes without those that nothing asks for beside the others."""
        for one in picked if len(picked) > 1 else []:
            others = [c for c in picked if c is not one]
            if self.left(others) <= self.asked_for:
                return self.needed(others)
        return picked

    def _outside(self, picked: Sequence[JudgedChange], i: int) -> JudgedChange:
        """One of the changes that were picked, or what outside the arm explains the readings as well."""
        hypothesis, rest = picked[i].hypothesis, [c for j, c in enumerate(picked) if j != i]
        if hypothesis.outside or hypothesis.kind == NOISE:
            return picked[i]
        asked = [h for h in self.others(rest) if h.outside]
        every = self.beside(rest).judge_all([*asked, hypothesis], bent=True)[0]
        likely = np.array([j.likelihood for j in every])
        first = put_back_first(len(asked), [*[True] * len(asked), False], likely, AS_LIKELY / self.weight)
        if first == len(asked):
            return picked[i]
        # beside another change that may only make up for what one size leaves, all sizes are open
        along = None if rest else along_one(asked[first], hypothesis, self.beside([]))
        alone = [] if along is None else self.beside(rest).judge_all([along])[0]
        return max([every[first], *alone], key=lambda one: one.log_factor)

    def _wave(self, picked: Sequence[JudgedChange], i: int) -> JudgedChange:
        """One of the changes that were picked; the wave that it is, where it is a curve of any course."""
        if not picked[i].hypothesis.free:
            return picked[i]
        beside = self.beside([c for j, c in enumerate(picked) if j != i])
        wave = wave_of(picked[i].hypothesis.curve, beside)
        return wave if wave is not None and wave.log_factor > picked[i].log_factor else picked[i]

    def nearest(self) -> FittedChange:
        """The row that explains most by itself, or what outside the arm explains as much, with its size and rivals."""
        one = self._outside([most_probable(*self.plain.judge_all(self.asked), weight=self.weight)], 0)
        return with_sizes([self.with_rivals([one], 0)], self.beside([one]), self.plain.null)[0][0]

    def told(self, found: Explanation, aside: Mapping[int, str]) -> FoundChanges:
        """What was found, with what explains the readings as well, and with sizes."""
        # more readings are wrong than are set aside: the others are not explained
        picked = [c for c in found.picked if not c.hypothesis.wrong]
        now = self.beside(picked)
        given = [FittedChange(judged, 1.0) for judged in self.fixed]
        covariance = np.empty((0, 0))
        changes = [self.with_rivals(picked, i) for i in range(len(picked))]
        if given or changes:
            every, covariance = with_sizes([*given, *changes], now, self.plain.null)
            given, changes = every[: len(given)], every[len(given) :]
        named, known = tuple(changes), tuple(given)
        return FoundChanges(named, known, covariance, found.log_e, aside, self.plain, now, tuple(self.asked))

    def with_rivals(self, picked: Sequence[JudgedChange], i: int) -> FittedChange:
        """One of the changes that were picked, with what explains the readings as well."""
        one, rest = picked[i], [c for j, c in enumerate(picked) if j != i]
        every, prior = self.beside(rest).judge_all(self.others(rest), bent=True)
        if not any(h is one.hypothesis for h in self.asked):  # a wave, or a move along one twist
            every, prior = [*every, one], np.r_[prior, self._price(one.hypothesis)]
        named = by_name(every, prior, self.weight)
        probability, best = named.pop(one.hypothesis.key)
        rivals = []
        for p, j in named.values():
            # what has more sizes explains all that has fewer; of what is rarer only the probability counts
            h, common = j.hypothesis, KINDS[best.hypothesis.kind].chance
            contained = bool(h.sizes) and j.likelihood > best.likelihood - AS_LIKELY / self.weight
            contained &= KINDS[h.kind].chance >= common
            if not h.wrong and (p > probability * np.exp(-AS_PROBABLE) or contained):
                rivals.append((p, j))
        rivals.sort(key=lambda pair: -pair[0])
        return FittedChange(replace(best, hypothesis=one.hypothesis), probability, tuple(j for _, j in rivals))


def with_sizes(changes: Sequence[FittedChange], now: CheckState, begin: NullModel) -> tuple[list[FittedChange], Array]:
    """The changes with their sizes, of a curve its angles at the stations, and the covariance (k, k) of all sizes.

    Of the null's grid the member counts that suits the readings best with the changes in; without them it would be a
    wider spread, for it would have to explain them.
    """
    for change in changes:
        if change.judged.is_noise:
            begin = begin.wider(begin.rows.extra(*change.judged.noise))
    judge, member = ChangeJudge(begin), now.judge.best
    columns = [now.turned(f.hypothesis.curve) if f.hypothesis.free else f.columns for f in now.fits]
    J = judge.whitened(np.concatenate(columns, axis=1), member)
    covariance = np.asarray(np.linalg.pinv(J.T @ J, hermitian=True), dtype=float)
    last = covariance @ (J.T @ judge.whitened(now.view.residual, member))  # of curves; of sizes it is none any more
    owner = np.repeat(np.arange(len(columns)), [c.shape[1] for c in columns])
    out, sized = [], np.ones(len(owner), bool)
    for i, (change, fit) in enumerate(zip(changes, now.fits, strict=True)):
        at = owner == i
        sized &= ~at | (not fit.hypothesis.free)
        sizes = last[at] if fit.hypothesis.free else fit.sizes
        out.append(replace(change, sizes=sizes, covariance=covariance[np.ix_(at, at)]))
    return out, covariance[np.ix_(sized, sized)]


def wave_of(joint: int, beside: CheckState) -> JudgedChange | None:
    """The wave that one joint's curve is, with how many cycles a turn; None where the readings do not say which.

    A few stations show a curve that varies from one to the next, and say little of its course between them. A wave has
    three sizes, or five with the second harmonic that strain wave gears have.
    """
    chain, null = beside.model.chain, beside.null
    if not chain.revolute[joint]:
        return None
    # of the noise the member that suits the readings best, or so many waves would take long
    state = CheckState(beside.model, beside.samples, beside.known, null.only(beside.judge.best))

    def judged(cycles: Array, double: bool) -> list[JudgedChange]:
        waves = (gear_harmonic.wave(chain.names[joint], float(c), double) for c in cycles)
        return state.judge_all([CellChange(GEAR, chain.names[joint], effects=(wave,)) for wave in waves])[0]

    grid = gear_harmonic.cycle_grid(max(float(np.ptp(state.samples.q[:, joint])), 0.1))
    every = {double: judged(grid[: len(grid) // (1 + double)], double) for double in (False, True)}
    mass = {double: scipy.special.logsumexp([j.log_factor for j in some]) for double, some in every.items()}
    evidence, double = max((mass[double] - np.log(len(every[double])), double) for double in every)
    logs = np.array([j.log_factor for j in every[double]])
    top, step = int(np.argmax(logs)), grid[1] - grid[0]
    near = np.abs(grid[: len(logs)] - grid[top]) <= _NEAR * step
    if scipy.special.logsumexp(logs[near]) - mass[double] <= np.log(_SURE):
        return None
    finest = max(judged(grid[top] + step * _FINER, double), key=lambda wave: wave.log_factor)
    (whole,), _ = beside.judge_all([finest.hypothesis])
    return replace(whole, log_factor=whole.log_factor + evidence - finest.log_factor)

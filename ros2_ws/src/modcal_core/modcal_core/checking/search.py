"""Which change it was: one after the other, at most two, each only if the readings ask for it.

The change that is most probable is taken up, and what is left is asked again. A second change may show that the first
was mistaken for it, so the first is then chosen again beside the second. What explains the readings as well as what is
named, whether at these stations or everywhere, is named with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration.model import Model
from modcal_core.checking.evidence import ChangeCandidate, ChangeJudge, JudgedChange, e_value, is_noise, log_priors
from modcal_core.checking.fitting import bends, fitted, taken_up
from modcal_core.checking.hypotheses import NOISE, READING, CellChange, hypotheses
from modcal_core.checking.noise import FrozenKnowledge
from modcal_core.checking.rivals import FittedChange, most_probable, with_rivals
from modcal_core.checking.sizes import SizeCovariance, with_sizes
from modcal_core.checking.state import CheckState
from modcal_core.checking.waves import wave_of
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples

FALSE_ALARM = 0.01  # chance that something is named while nothing has changed, over all changes together
_BEAM = 5  # changes that a pair is begun with


@dataclass(frozen=True)
class FoundChanges:
    """What a search found.

    model: with the changes put in. changes: at most two. log_e: logarithms of the e-values by which each was asked for,
    and, last, of what is left. aside: samples that were set aside as wrong. samples: the others. start: the null
    before, on them. left: the one after. state: the model with the changes, beside them. sizes: what is known of these.
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

    @property
    def more(self) -> bool:
        """Whether what was found does not explain all."""
        return self.log_e[-1] > -np.log(FALSE_ALARM)


def search(model: Model, samples: Samples, known: FrozenKnowledge) -> FoundChanges:
    """What has changed since the model was frozen, by these samples."""
    rows = np.arange(len(samples))
    aside: list[int] = []
    allowed = max(1, len(samples) // 10)
    while True:
        part = samples.select(rows)
        found = _search(model, part, known)
        wrong = next((c for c in found.changes if c.hypothesis.kind == READING), None)
        if wrong is None or len(aside) >= allowed or len(rows) < 4:
            return replace(found, aside=tuple(aside))
        out = rows[wrong.hypothesis.sample]
        aside.append(int(out))
        rows = rows[rows != out]


def _search(model: Model, samples: Samples, known: FrozenKnowledge) -> FoundChanges:
    state = begin = CheckState(model, samples, known)
    fits: list[ChangeCandidate] = []
    start = now = ChangeJudge(state.null)
    asked = hypotheses(model, samples)
    judged, prior = _judge_all(start, begin, asked, bent=True)
    log_e = [e_value(judged, prior, state.null.weight)]
    picked: list[JudgedChange] = []
    if log_e[0] > -np.log(FALSE_ALARM):
        first = most_probable(judged, prior, state.null.weight)
        if first.candidate.hypothesis.kind == READING:  # the caller sets it aside and begins again
            wrong = FittedChange(first, 1.0, ())
            return FoundChanges(
                model, (wrong,), tuple(log_e), (), samples, start, now, state, SizeCovariance.none(known)
            )
        picked = [first]
        state, fits, now, rest = _taken(model, samples, known, picked, asked)
        log_e.append(rest)
        if rest > -np.log(FALSE_ALARM) or is_noise(first):
            pair = _best_pair(model, samples, known, judged, prior, asked, start)
            alone = first.log_factor + float(prior[[j is first for j in judged]][0])
            if pair is not None and (
                rest > -np.log(FALSE_ALARM) or begin.null.weight * (pair[1] - alone) > -np.log(FALSE_ALARM)
            ):
                picked = pair[0]
                state, fits, now, rest = _taken(model, samples, known, picked, asked)
                log_e = [log_e[0], begin.null.weight * max(pair[1] - alone, 0.0), rest]
    for i, one in enumerate(picked):
        if one.candidate.free:
            others = [p for j, p in enumerate(picked) if j != i]
            beside = taken_up(model, samples, known, others)[0]
            curve = one.candidate.hypothesis.curve
            wave = wave_of(curve, beside.model, beside.view, beside.drivers, ChangeJudge(beside.null))
            if wave is not None and wave.log_factor > one.log_factor:
                picked[i] = wave
                state, fits, now, log_e[-1] = _taken(model, samples, known, picked, asked)
    changes = []
    for i, one in enumerate(picked):
        others = [p for j, p in enumerate(picked) if j != i]
        beside = taken_up(model, samples, known, others)[0]
        judge = ChangeJudge(beside.null)
        every, prior = _judge_all(judge, beside, [h for h in asked if h.key not in _keys(others)], bent=True)
        if not any(h is one.candidate.hypothesis for h in asked):  # a wave that was found by scanning
            own = [
                p
                for j, p in zip(every, prior, strict=True)
                if j.candidate.hypothesis.key == one.candidate.hypothesis.key
            ]
            every, prior = [*every, one], np.r_[prior, max(own)]
        changes.append(with_rivals(one, every, prior, begin.null.weight))
    changes, sizes = with_sizes(changes, fits, state, begin.null, now.best)
    return FoundChanges(state.model, tuple(changes), tuple(log_e), (), samples, start, now, state, sizes)


def _taken(
    model: Model, samples: Samples, known: FrozenKnowledge, picked: Sequence[JudgedChange], asked: Sequence[CellChange]
) -> tuple[CheckState, list[ChangeCandidate], ChangeJudge, float]:
    """The state with these changes taken up, the changes as fitted, the judge of what is left, and its e-value."""
    state, fits = taken_up(model, samples, known, picked)
    now = ChangeJudge(state.null)
    judged, prior = _judge_all(now, state, [h for h in asked if h.key not in _keys(picked)])
    return state, fits, now, e_value(judged, prior, state.null.weight)


def _best_pair(
    model: Model,
    samples: Samples,
    known: FrozenKnowledge,
    judged: Sequence[JudgedChange],
    prior: Array,
    asked: Sequence[CellChange],
    start: ChangeJudge,
) -> tuple[list[JudgedChange], float] | None:
    """The two changes that are most probable together, and the logarithm of how much.

    One of them is among the few most probable alone; it is chosen again beside the other.
    """
    by_key: dict[tuple[str, str], tuple[float, JudgedChange]] = {}
    for j, p in zip(judged, prior, strict=True):
        value = j.log_factor + float(p)
        h = j.candidate.hypothesis
        if h.kind not in (READING, NOISE) and value > by_key.get(h.key, (-np.inf, j))[0]:
            by_key[h.key] = (value, j)
    tried = [first for _, first in sorted(by_key.values(), key=lambda pair: -pair[0])[:_BEAM]]
    best: tuple[list[JudgedChange], float] | None = None
    for first in tried:
        found = _second(model, samples, known, first, start, asked)
        if best is None or found[1] > best[1]:
            best = found
    if best is not None:  # the second may be the better beginning
        again = _second(model, samples, known, best[0][1], start, asked)
        best = max(best, again, key=lambda pair: pair[1])
    return best


def _second(
    model: Model,
    samples: Samples,
    known: FrozenKnowledge,
    first: JudgedChange,
    start: ChangeJudge,
    asked: Sequence[CellChange],
) -> tuple[list[JudgedChange], float]:
    """The most probable change beside a first one, and how probable both are together."""
    beside = taken_up(model, samples, known, [first])[0]
    judge = ChangeJudge(beside.null)
    rest = [h for h in asked if h.key != first.candidate.hypothesis.key and h.kind != READING]
    judged, prior = _judge_all(judge, beside, rest)
    value = np.array([j.log_factor for j in judged]) + prior
    at = int(np.argmax(value))
    own = log_priors(asked)[next(i for i, h in enumerate(asked) if h is first.candidate.hypothesis)]
    return [first, judged[at]], float(judge.log_null - start.log_null + value[at] + own)


def _keys(judged: Sequence[JudgedChange]) -> set[tuple[str, str]]:
    return {j.candidate.hypothesis.key for j in judged}


def _judge_all(
    judge: ChangeJudge, state: CheckState, asked: Sequence[CellChange], bent: bool = False
) -> tuple[list[JudgedChange], Array]:
    """What speaks for each. bent: fit each by itself where changes are so large that their motions bend."""
    large = bent and bends(judge)
    out = []
    for hypothesis in asked:
        if hypothesis.kind == NOISE:
            out.append(judge.noisier(hypothesis))
        elif large and (hypothesis.sizes or hypothesis.curve >= 0):
            out.append(judge.judged(fitted([hypothesis], state, judge, bent=True)[0][0]))
        else:
            columns = state.columns(hypothesis)
            out.append(
                judge.judged(ChangeCandidate(hypothesis, state.null.residual, columns, np.zeros(columns.shape[1])))
            )
    return out, log_priors(asked)

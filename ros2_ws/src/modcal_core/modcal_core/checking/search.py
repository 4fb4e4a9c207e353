"""Which change it was: one after the other, at most two, each only if the readings ask for it.

The change that is most probable is taken up, and what is left is asked again. A second change may show that the first
was mistaken for it, so the first is then chosen again beside the second. What explains the readings as well as what is
named, whether at these stations or everywhere, is named with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy

from modcal_core.calibration.linearise import RowView
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.checking.evidence import (
    ChangeCandidate,
    ChangeJudge,
    JudgedChange,
    e_value,
    is_noise,
    log_priors,
    probabilities,
)
from modcal_core.checking.hypotheses import (
    NOISE,
    READING,
    CellChange,
    composed,
    curve_columns,
    curve_root,
    hypotheses,
    hypothesis_columns,
    put_in,
)
from modcal_core.checking.noise import FrozenKnowledge, NullModel, null, parameter_rows
from modcal_core.checking.waves import wave_of
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples

FALSE_ALARM = 0.01  # chance that something is named while nothing has changed, over all changes together
_AS_PROBABLE = 3.0  # in log-probability (20 to 1), within which two changes are not told apart
_AS_LIKELY = 3.5  # the same of the largest likelihood, where one change contains the other
_LARGE = 30.0  # squared standard deviations a row, beyond which each change is fitted by itself before it is compared
_BEAM = 5  # changes that a pair is begun with
_STEPS = 15  # of a fit; of changes that are small one is enough
_END = 1e-3  # standard deviations, all rows together; the last step of a fit
_LONGEST = 0.5  # rad; a longer turn is taken in parts
_WIDE = 4.0  # times its own size: what a change that was taken up may still be off by


@dataclass(frozen=True)
class FittedChange:
    """A change as it is named. judged: what speaks for it. sizes, std: [m, rad, 1], with their covariance. same_as:
    others that explain the same. probability: that it is this one of all.
    """

    judged: JudgedChange
    probability: float
    same_as: tuple[JudgedChange, ...]
    sizes: Array = field(default_factory=lambda: np.empty(0))
    covariance: Array = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def hypothesis(self) -> CellChange:
        """What changed."""
        return self.judged.candidate.hypothesis


@dataclass(frozen=True)
class FoundChanges:
    """What a search found. model: with the changes put in. changes: at most two. log_e: logarithms of the e-values by
    which each was asked for, and, last, of what is left. aside: samples that were set aside as wrong. samples: the
    others. start: the null before, on them. left: the one after. state: the model with the changes, beside them. sizes:
    what is known of these.
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
    log_e = [e_value(judged, prior)]
    picked: list[JudgedChange] = []
    if log_e[0] > -np.log(FALSE_ALARM):
        first = _most_probable(judged, prior)
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
            if pair is not None and (rest > -np.log(FALSE_ALARM) or pair[1] > alone - np.log(FALSE_ALARM)):
                picked = pair[0]
                state, fits, now, rest = _taken(model, samples, known, picked, asked)
                log_e = [log_e[0], max(pair[1] - alone, 0.0), rest]
    for i, one in enumerate(picked):
        if one.candidate.free:
            others = [p for j, p in enumerate(picked) if j != i]
            beside = _after(model, samples, known, others)[0]
            curve = one.candidate.hypothesis.curve
            wave = wave_of(curve, beside.model, beside.view, beside.drivers, ChangeJudge(beside.null))
            if wave is not None and wave.log_factor > one.log_factor:
                picked[i] = wave
                state, fits, now, log_e[-1] = _taken(model, samples, known, picked, asked)
    changes = []
    for i, one in enumerate(picked):
        others = [p for j, p in enumerate(picked) if j != i]
        beside = _after(model, samples, known, others)[0]
        judge = ChangeJudge(beside.null)
        every, prior = _judge_all(judge, beside, [h for h in asked if h.key not in _keys(others)], bent=True)
        if not any(h is one.candidate.hypothesis for h in asked):  # a wave that was found by scanning
            own = [
                p
                for j, p in zip(every, prior, strict=True)
                if j.candidate.hypothesis.key == one.candidate.hypothesis.key
            ]
            every, prior = [*every, one], np.r_[prior, max(own)]
        changes.append(_named(one, every, prior))
    changes, sizes = _with_sizes(changes, fits, state, begin.null)
    return FoundChanges(state.model, tuple(changes), tuple(log_e), (), samples, start, now, state, sizes)


def _taken(
    model: Model, samples: Samples, known: FrozenKnowledge, picked: Sequence[JudgedChange], asked: Sequence[CellChange]
) -> tuple[CheckState, list[ChangeCandidate], ChangeJudge, float]:
    """The state with these changes taken up, the changes as fitted, the judge of what is left, and its e-value."""
    state, fits = _after(model, samples, known, picked)
    now = ChangeJudge(state.null)
    judged, prior = _judge_all(now, state, [h for h in asked if h.key not in _keys(picked)])
    return state, fits, now, e_value(judged, prior)


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
    beside = _after(model, samples, known, [first])[0]
    judge = ChangeJudge(beside.null)
    rest = [h for h in asked if h.key != first.candidate.hypothesis.key and h.kind != READING]
    judged, prior = _judge_all(judge, beside, rest)
    value = np.array([j.log_factor for j in judged]) + prior
    at = int(np.argmax(value))
    own = log_priors(asked)[next(i for i, h in enumerate(asked) if h is first.candidate.hypothesis)]
    return [first, judged[at]], float(judge.log_null - start.log_null + value[at] + own)


class CheckState:
    """A model beside the samples, what its readings scatter by, and its derivatives."""

    def __init__(self, model: Model, samples: Samples, known: FrozenKnowledge, of: NullModel | None = None) -> None:
        self.model, self.samples, self.known = model, samples, known
        self.drivers = model.drivers(samples)
        self.view = RowView.of(model, samples, self.drivers)
        self._of = of

    @cached_property
    def null(self) -> NullModel:
        """What its readings scatter by while nothing else has changed."""
        return null(self.model, self.samples, self.view, self.drivers, self.known) if self._of is None else self._of

    def parameter_rows(self, parameters: tuple[ModelParameter, ...]) -> Array:
        """Derivatives of the predictions by these parameters of the geometry, (P, n)."""
        return parameter_rows(self.model, self.view, self.drivers, parameters, ())

    @property
    def residual(self) -> Array:
        """Of the rows of a linearisation, (n,)."""
        return np.concatenate([self.view.position.ravel(), self.view.rotation.ravel()])

    def columns(self, hypothesis: CellChange) -> Array:
        """Of a change, at this model; none of noise, which has no size."""
        if hypothesis.kind == NOISE:
            return np.zeros((len(self.residual), 0))
        if hypothesis.curve >= 0:
            return curve_columns(hypothesis.curve, self.model, self.view)
        return hypothesis_columns(hypothesis, self.model, self.view, self.drivers)


def _keys(judged: Sequence[JudgedChange]) -> set[tuple[str, str]]:
    return {j.candidate.hypothesis.key for j in judged}


def _judge_all(
    judge: ChangeJudge, state: CheckState, asked: Sequence[CellChange], bent: bool = False
) -> tuple[list[JudgedChange], Array]:
    """What speaks for each. bent: fit each by itself where changes are so large that their motions bend."""
    large = bent and judge.square > _LARGE * len(state.null.residual)
    out = []
    for hypothesis in asked:
        if hypothesis.kind == NOISE:
            out.append(judge.noisier(hypothesis))
        elif large and hypothesis.sizes:
            out.append(judge.judged(_fitted([hypothesis], state, judge)[0][0]))
        else:
            columns = state.columns(hypothesis)
            out.append(
                judge.judged(ChangeCandidate(hypothesis, state.null.residual, columns, np.zeros(columns.shape[1])))
            )
    return out, log_priors(asked)


def _most_probable(judged: Sequence[JudgedChange], prior: Array) -> JudgedChange:
    """The most probable thing to name, by its most probable shape."""
    chance = probabilities(judged, prior)
    of_key: dict[tuple[str, str], float] = {}
    for j, p in zip(judged, chance, strict=True):
        key = j.candidate.hypothesis.key
        of_key[key] = of_key.get(key, 0.0) + float(p)
    best = max(of_key, key=lambda k: of_key[k])
    return max(
        ((p, j) for j, p in zip(judged, chance, strict=True) if j.candidate.hypothesis.key == best),
        key=lambda pair: pair[0],
    )[1]


def _after(
    model: Model, samples: Samples, known: FrozenKnowledge, picked: Sequence[JudgedChange]
) -> tuple[CheckState, list[ChangeCandidate]]:
    """The state in which these changes have been taken up, their sizes left open, and the changes as fitted."""
    begin = CheckState(model, samples, known)
    if not picked:
        return begin, []
    fits, now = _fitted([p.candidate.hypothesis for p in picked], begin, ChangeJudge(begin.null))
    opened = begin.null
    for judged, candidate in zip(picked, fits, strict=True):
        if is_noise(judged):
            opened = opened.with_noise(*judged.noise)
            continue
        columns = now.columns(candidate.hypothesis)
        L = np.linalg.cholesky(opened.covariances[opened.reference])
        A = scipy.linalg.solve_triangular(L, columns, lower=True)
        n = len(opened.residual)
        if candidate.free:
            scale = judged.size * np.sqrt(n / max(float(np.sum(A**2)), 1e-300))
        else:
            _, s, Vt = np.linalg.svd(A, full_matrices=False)
            keep = s > 1e-9 * max(float(s.max(initial=0.0)), 1e-300)
            columns = columns @ (Vt[keep].T / s[keep])
            scale = _WIDE * judged.size * np.sqrt(n / max(int(keep.sum()), 1))
        opened = opened.with_more(now.residual, columns, scale)
    opened = replace(opened, residual=now.residual)
    return CheckState(now.model, samples, known, opened), fits


def _fitted(
    asked: Sequence[CellChange], state: CheckState, judge: ChangeJudge
) -> tuple[list[ChangeCandidate], CheckState]:
    """These changes fitted together by Gauss-Newton steps, and the state with them put in.

    Curves that may take any course, noise and wrong readings have no sizes to put in.
    """
    sized = [h for h in asked if h.sizes]
    totals = [np.zeros(h.sizes) for h in sized]
    model, now = state.model, state
    member = state.null.reference
    before = np.inf
    for _ in range(_STEPS if sized else 0):
        z = judge.whitened(now.residual, member)
        square = float(z @ z)
        blocks = [now.columns(h) for h in sized]
        A = judge.whitened(np.concatenate(blocks, axis=1), member)
        scale = np.maximum(np.linalg.norm(A, axis=0), 1e-300)
        step = np.linalg.lstsq(A / scale, z, rcond=1e-8)[0] / scale
        gain = float(np.linalg.norm(A @ step))
        if gain < _END or square > 4.0 * before:
            break
        before = square
        parts = np.split(step, np.cumsum([len(t) for t in totals])[:-1])
        shorter = min([1.0, *(_LONGEST / max(float(np.linalg.norm(p[3:])), 1e-9) for p in parts if len(p) == 6)])
        for i, (h, part) in enumerate(zip(sized, parts, strict=True)):
            model = put_in(h, model, shorter * part)
            totals[i] = composed(h, totals[i], shorter * part)
        now = CheckState(model, state.samples, state.known, state.null)
    by_key = {id(h): t for h, t in zip(sized, totals, strict=True)}
    return [
        ChangeCandidate(h, now.residual, now.columns(h) if h.kind != NOISE else np.zeros((len(now.residual), 0)),
                  by_key.get(id(h), np.empty(0)))
        for h in asked
    ], now  # fmt: skip


def _named(best: JudgedChange, every: Sequence[JudgedChange], prior: Array) -> FittedChange:
    """What is named, with what explains the readings as well."""
    chance = probabilities(every, prior)
    by_key: dict[tuple[str, str], tuple[float, JudgedChange]] = {}
    for j, p in zip(every, chance, strict=True):
        key = j.candidate.hypothesis.key
        so_far = by_key.get(key)
        top = j if so_far is None or j.log_factor > so_far[1].log_factor else so_far[1]
        by_key[key] = (float(p) + (so_far[0] if so_far else 0.0), top)
    own = by_key.get(best.candidate.hypothesis.key, (1.0, best))
    likely = own[1].likelihood
    rivals = []
    for key, (p, j) in by_key.items():
        if key == best.candidate.hypothesis.key or j.candidate.hypothesis.kind == READING:
            continue
        as_probable = p > own[0] * np.exp(-_AS_PROBABLE)
        contained = bool(j.candidate.hypothesis.sizes) and j.likelihood > likely - _AS_LIKELY
        if as_probable or contained:
            rivals.append((p, j))
    rivals.sort(key=lambda pair: -pair[0])
    return FittedChange(own[1], own[0], tuple(j for _, j in rivals))


@dataclass(frozen=True)
class SizeCovariance:
    """What is known of the sizes of all changes together. covariance: (k, k). cross: with what the calibration does not
    know of itself, (K, k): the error of a size makes up for a part of that.
    """

    covariance: Array
    cross: Array

    @classmethod
    def none(cls, known: FrozenKnowledge) -> SizeCovariance:
        """Of no change."""
        return cls(np.empty((0, 0)), np.empty((len(known.covariance), 0)))


def _with_sizes(
    changes: Sequence[FittedChange], fits: Sequence[ChangeCandidate], state: CheckState, begin: NullModel
) -> tuple[list[FittedChange], SizeCovariance]:
    """The changes with their sizes, and what is known of these beside each other."""
    known = state.known
    if not changes:
        return [], SizeCovariance.none(known)
    for change in changes:
        if is_noise(change.judged):
            begin = begin.with_noise(*change.judged.noise)
    judge = ChangeJudge(begin)
    n = len(begin.residual)
    blocks, roots = [], []
    for change, fit in zip(changes, fits, strict=True):
        if fit.free:
            A = judge.whitened(fit.columns, judge.best)
            spread = change.judged.size * np.sqrt(n / max(float(np.sum(A**2)), 1e-300))
            blocks.append(spread * A)
            roots.append(spread * curve_root(fit.hypothesis.curve, state.model, state.samples))
        else:
            sized = bool(fit.hypothesis.sizes)
            blocks.append(judge.whitened(state.columns(fit.hypothesis), judge.best) if sized else np.zeros((n, 0)))
            roots.append(np.empty((0, 0)))
    J = np.concatenate(blocks, axis=1)
    prior = np.concatenate([np.full(b.shape[1], float(f.free)) for b, f in zip(blocks, fits, strict=True)])
    covariance = np.linalg.pinv(J.T @ J + np.diag(prior), hermitian=True)
    mean = covariance @ (J.T @ judge.whitened(state.residual, judge.best))  # of curves; of sizes it is the last step
    own = parameter_rows(state.model, state.view, state.drivers, known.parameters, known.effects)
    cross = -known.covariance @ judge.whitened(own.T, judge.best).T @ J @ covariance
    out: list[FittedChange] = []
    kept: list[int] = []
    first = 0
    for change, fit, block, root in zip(changes, fits, blocks, roots, strict=True):
        rows = slice(first, first + block.shape[1])
        first += block.shape[1]
        part = covariance[rows, rows]
        change = replace(
            change, judged=replace(change.judged, candidate=replace(change.judged.candidate, hypothesis=fit.hypothesis))
        )
        if fit.free:
            out.append(replace(change, sizes=root @ mean[rows], covariance=root @ part @ root.T))
        else:
            out.append(replace(change, sizes=fit.sizes, covariance=part))
            kept += range(rows.start, rows.stop)
    return out, SizeCovariance(covariance[np.ix_(kept, kept)], cross[:, kept])

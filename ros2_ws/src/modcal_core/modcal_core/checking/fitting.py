"""Changes put into the model: fitted together by Gauss-Newton steps, or taken up with their sizes left open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy

from modcal_core.checking.evidence import ChangeCandidate, ChangeJudge, JudgedChange, is_noise, log_priors
from modcal_core.checking.hypotheses import NOISE, CellChange, composed, put_in
from modcal_core.checking.state import CheckState
from modcal_core.geometry import Array

_STEPS = 15  # of a fit; of changes that are small one is enough
_END = 1e-3  # standard deviations, all rows together; the last step of a fit
_SHARE = 1e-4  # of the residual, of which a step that moves less decides nothing between changes
_LARGE = 30.0  # squared standard deviations a row, beyond which each change is fitted by itself before it is compared
_LONGEST = 0.5  # rad; a longer turn is taken in parts
_WIDE = 4.0  # times its own size: what a change that was taken up may still be off by


def taken_up(
    begin: CheckState, judge: ChangeJudge, picked: Sequence[JudgedChange]
) -> tuple[CheckState, list[ChangeCandidate]]:
    """The state in which these changes have been taken up, their sizes left open, and the changes as fitted.

    begin: without them. judge: of what that leaves.
    """
    fits, now = fitted([p.candidate.hypothesis for p in picked], begin, judge, bends(judge))
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
    return CheckState(now.model, begin.samples, begin.known, opened, now.curves), fits


def along_one(outside: CellChange, hypothesis: CellChange, state: CheckState) -> CellChange | None:
    """What outside the arm moves, only as a change of one size moves the readings; None where that has more sizes.

    Few stations show one number better than six.
    """
    if hypothesis.sizes != 1 or not outside.motions or outside.together:
        return None
    L = np.linalg.cholesky(state.null.covariances[state.null.reference])
    A, y = (scipy.linalg.solve_triangular(L, state.columns(h), lower=True) for h in (outside, hypothesis))
    twist = np.linalg.lstsq(A, y[:, 0], rcond=1e-9)[0] @ np.array([m.twist for m in outside.motions])
    return replace(outside, motions=(replace(outside.motions[0], twist=tuple(twist.tolist())),))


def bends(judge: ChangeJudge) -> bool:
    """Whether what is missed is so large that the motions by a change are no longer in proportion to it."""
    return judge.square > _LARGE * len(judge.null.residual)


def fitted(
    asked: Sequence[CellChange], state: CheckState, judge: ChangeJudge, bent: bool = False
) -> tuple[list[ChangeCandidate], CheckState]:
    """These changes fitted together by Gauss-Newton steps, and the state with them put in.

    Curves that may take any course, noise and wrong readings have no sizes to put in. bent: linearise curves about
    their angles at the stations.
    """
    sized = [h for h in asked if h.sizes]
    curves = [h.curve for h in asked if h.curve >= 0] if bent else []
    totals = [np.zeros(h.sizes) for h in sized]
    model, now = state.model, state
    member = state.null.reference
    angles = {j: np.zeros(len(np.unique(state.samples.station))) for j in curves}
    before = np.inf
    for _ in range(_STEPS if sized or curves else 0):
        turned = {j: now.turned(j) for j in curves}
        z = judge.whitened(now.residual - sum((turned[j] @ angles[j] for j in curves), np.zeros(1)), member)
        square = float(z @ z)
        A = judge.whitened(np.concatenate([*(now.columns(h) for h in sized), *turned.values()], axis=1), member)
        if angles:  # of a station at which the joint moves nothing no angle follows
            so_far = np.concatenate(list(angles.values()))
            A = np.concatenate([A, np.eye(len(so_far), A.shape[1], A.shape[1] - len(so_far)) / _LONGEST])
            z = np.r_[z, -so_far / _LONGEST]
        scale = np.maximum(np.linalg.norm(A, axis=0), 1e-300)
        step = np.linalg.lstsq(A / scale, z, rcond=1e-8)[0] / scale
        gain = float(np.linalg.norm(A @ step))
        if gain < max(_END, _SHARE * np.sqrt(square)) or square > 4.0 * before:
            break
        before = square
        ends = np.cumsum([len(t) for t in totals] + [len(a) for a in angles.values()])[:-1]
        pieces = np.split(step, ends)
        parts = pieces[: len(sized)]
        for j, turn in zip(curves, pieces[len(sized) :], strict=True):
            angles[j] = angles[j] + np.clip(turn, -_LONGEST, _LONGEST)
        shorter = min([1.0, *(_LONGEST / max(float(np.linalg.norm(p[3:])), 1e-9) for p in parts if len(p) == 6)])
        for i, (h, part) in enumerate(zip(sized, parts, strict=True)):
            model = put_in(h, model, shorter * part)
            totals[i] = composed(h, totals[i], shorter * part)
        now = CheckState(model, state.samples, state.known, state.null, {**state.curves, **angles})
    by_key = {id(h): t for h, t in zip(sized, totals, strict=True)}
    return [
        ChangeCandidate(h, now.residual, now.columns(h) if h.kind != NOISE else np.zeros((len(now.residual), 0)),
                  by_key.get(id(h), np.empty(0)))
        for h in asked
    ], now  # fmt: skip


@dataclass
class ChangedState:
    """state: with the changes taken up. fits: these changes as fitted. judge: of what is left."""

    state: CheckState
    fits: Sequence[ChangeCandidate]
    judge: ChangeJudge
    _judged: dict[tuple[int, bool], tuple[CellChange, JudgedChange]] = field(default_factory=dict)

    def judge_all(self, asked: Sequence[CellChange], bent: bool = False) -> tuple[list[JudgedChange], Array]:
        """What speaks for each, and the logarithms of their prior probabilities. bent: fit each by itself where changes
        are so large that their motions bend.
        """
        large = bent and bends(self.judge)
        return [self._one(h, large and (h.sizes > 0 or h.curve >= 0)) for h in asked], log_priors(asked)

    def _one(self, hypothesis: CellChange, alone: bool) -> JudgedChange:
        """What speaks for one change. alone: fit it by itself first."""
        key = id(hypothesis), alone
        if key not in self._judged:  # kept with its key: the number of an object is another's once it is gone
            self._judged[key] = hypothesis, self._ask(hypothesis, alone)
        return self._judged[key][1]

    def _ask(self, hypothesis: CellChange, alone: bool) -> JudgedChange:
        if hypothesis.kind == NOISE:
            return self.judge.noisier(hypothesis)
        if alone:
            return self.judge.judged(fitted([hypothesis], self.state, self.judge, bent=True)[0][0])
        columns = self.state.columns(hypothesis)
        residual = self.state.null.residual
        return self.judge.judged(ChangeCandidate(hypothesis, residual, columns, np.zeros(columns.shape[1])))


class ChangedStates:
    """What stands once changes are taken up, on top of a model beside the readings."""

    def __init__(self, plain: CheckState) -> None:
        self.plain = ChangedState(plain, (), ChangeJudge(plain.null))
        self._known: dict[tuple[int, ...], tuple[list[JudgedChange], ChangedState]] = {}

    def after(self, picked: Sequence[JudgedChange]) -> ChangedState:
        """With these changes taken up."""
        if not picked:
            return self.plain
        key = tuple(map(id, picked))
        if key not in self._known:
            state, fits = taken_up(self.plain.state, self.plain.judge, picked)
            self._known[key] = list(picked), ChangedState(state, fits, ChangeJudge(state.null))
        return self._known[key][1]

"""A frozen model beside readings: residuals, derivatives, and the same once changes have been taken up.

A change is fitted by Gauss-Newton steps and then left open: its columns join the covariance, so that what is asked next
is asked beside every size that it may have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from modcal_core.calibration import Model, RowView
from modcal_core.geometry import Array, combined, error_values, se3
from modcal_core.measurements import Samples
from modcal_core.measurements.kinds import is_direct
from modcal_core.moves.likelihood import (
    ChangeCandidate,
    ChangeJudge,
    FrozenKnowledge,
    JudgedChange,
    NullModel,
    RowKinds,
    curve_root,
    null,
)
from modcal_core.moves.rows import BASE, NOISE, TOOL, CellChange, composed, hypothesis_columns, log_priors, put_in
from modcal_core.moves.setups import SetupReadings

_STEPS = 15  # of a fit; of changes that are small one is enough
_END = 1e-3  # standard deviations, all rows together; the last step of a fit
_SHARE = 1e-4  # of the residual, of which a step that moves less decides nothing between changes
_LARGE = 30.0  # squared standard deviations a row, beyond which each change is fitted by itself before it is compared
_LONGEST = 0.5  # rad; a longer turn is taken in parts
_WIDE = 4.0  # times its own size: what a change that was taken up may still be off by


class CheckState:
    """A model beside the samples, what its readings scatter by, and its derivatives.

    of: the null, where it is known already. linear: whether changes are taken up in proportion, since the model has
    them already and the null's residual not. fits: changes that were taken up, as fitted.
    """

    def __init__(
        self, model: Model, samples: Samples, known: FrozenKnowledge, of: NullModel | None = None, linear: bool = False
    ) -> None:
        self.model, self.samples, self.known, self.linear = model, samples, known, linear
        self.drivers = model.drivers(samples)
        self.view = RowView.of(model, samples, self.drivers)
        self._of = of
        self.fits: Sequence[ChangeCandidate] = ()
        self._judged: dict[tuple[int, bool], tuple[CellChange, JudgedChange]] = {}

    @cached_property
    def null(self) -> NullModel:
        """What its readings scatter by while nothing else has changed."""
        return null(self.model, self.samples, self.view, self.drivers, self.known) if self._of is None else self._of

    @cached_property
    def judge(self) -> ChangeJudge:
        """What the null says of changes."""
        return ChangeJudge(self.null)

    @cached_property
    def row_samples(self) -> np.ndarray:
        """The sample of each row, (n,)."""
        return np.concatenate([np.tile(np.arange(len(self.samples)), 3), np.tile(self.view.pose, 3)]).astype(int)

    @property
    def weights(self) -> Array:
        """One over the standard deviation of each row by the spread alone, (n,)."""
        return np.asarray(1.0 / np.sqrt(RowKinds.of(self.samples, self.known.noise).variance))

    def turned(self, joint: int) -> Array:
        """What readings move by per unit of a joint's angle or travel at each station, (n, S)."""
        chain, station = self.model.chain, np.unique(self.samples.station, return_inverse=True)[1]
        unit = self.view.unit_column(chain.first_place + joint, 5 if chain.revolute[joint] else 2)
        return unit[:, None] * (station[self.row_samples][:, None] == np.arange(station.max() + 1))

    def columns(self, hypothesis: CellChange) -> Array:
        """Columns of a change at this model; none for noise, which has no size."""
        if hypothesis.kind == NOISE:
            return np.zeros((len(self.view.residual), 0))
        if hypothesis.free:
            return self.turned(hypothesis.curve) @ curve_root(hypothesis.curve, self.model, self.samples)
        return hypothesis_columns(hypothesis, self.model, self.view, self.drivers)

    def judge_all(self, asked: Sequence[CellChange], bent: bool = False) -> tuple[list[JudgedChange], Array]:
        """What speaks for each, and the logarithms of their prior probabilities. bent: fit each by itself where what is
        missed is so large that the motions by a change are no longer in proportion to it.
        """
        large = bent and not self.linear and self.judge.square > _LARGE * len(self.null.residual)
        return [self._judge_one(h, large and (h.sizes > 0 or h.free)) for h in asked], log_priors(asked)

    def _judge_one(self, h: CellChange, alone: bool) -> JudgedChange:
        key = id(h), alone
        if key not in self._judged:  # kept with its key: the number of an object is another's once it is gone
            if h.kind == NOISE:
                judged = self.judge.noisier(h)
            elif alone and h.free:  # a curve is a small change, or in proportion it would take up anything
                judged = JudgedChange(h, -np.inf, -np.inf, 1.0)
            else:
                plain = ChangeCandidate(h, self.null.residual, self.columns(h))
                judged = self.judge.judged(fitted([h], self)[0][0] if alone else plain)
            self._judged[key] = h, judged
        return self._judged[key][1]

    def with_these(self, picked: Sequence[JudgedChange]) -> CheckState:
        """The state in which these changes have been taken up, their sizes left open."""
        if not picked:
            return self
        fits, now = fitted([p.hypothesis for p in picked], self)
        opened = replace(self.null, residual=fits[0].residual)
        for judged, candidate in zip(picked, fits, strict=True):
            if judged.is_noise:
                opened = opened.wider(opened.rows.extra(*judged.noise))
                continue
            columns, size = candidate.columns, judged.size * np.sqrt(len(opened.residual))
            A = opened.whitened(columns)
            if judged.hypothesis.free:
                columns = size / np.sqrt(max(float(np.sum(A**2)), 1e-300)) * columns
            else:
                _, s, Vt = np.linalg.svd(A, full_matrices=False)
                keep = s > 1e-9 * max(float(s.max(initial=0.0)), 1e-300)
                columns = _WIDE * size / np.sqrt(max(int(keep.sum()), 1)) * columns @ (Vt[keep].T / s[keep])
            opened = opened.wider(columns @ columns.T)
        state = CheckState(now.model, now.samples, now.known, opened, now.linear)
        state.fits = fits
        return state


def fitted(asked: Sequence[CellChange], state: CheckState) -> tuple[list[ChangeCandidate], CheckState]:
    """These changes fitted together by Gauss-Newton steps, and the state with them put in.

    Curves that may take any course, noise and wrong readings have no sizes to put in.
    """
    sized = [h for h in asked if h.sizes]
    model, now, judge, member = state.model, state, state.judge, state.null.reference
    if state.linear:
        columns, r = [state.columns(h) for h in asked], state.null.residual
        A = np.concatenate(columns, axis=1)
        sizes = np.linalg.lstsq(judge.whitened(A, member), judge.whitened(r, member), rcond=1e-8)[0]
        each = np.split(sizes, np.cumsum([c.shape[1] for c in columns])[:-1])
        return [ChangeCandidate(h, r - A @ sizes, *of) for h, *of in zip(asked, columns, each, strict=True)], state
    totals, before = _set_up(sized, state), np.inf
    for h, total in zip(sized, totals, strict=True):
        model = put_in(h, model, total) if total.any() else model
    if model is not state.model:
        now = CheckState(model, state.samples, state.known, state.null)
    for _ in range(_STEPS if sized else 0):
        z = judge.whitened(now.view.residual, member)
        square = float(z @ z)
        A = judge.whitened(np.concatenate([now.columns(h) for h in sized], axis=1), member)
        by = combined(A, z)
        gain = float(np.linalg.norm(A @ by))
        if gain < max(_END, _SHARE * np.sqrt(square)) or square > 4.0 * before:
            break
        before = square
        parts = np.split(by, np.cumsum([*map(len, totals)])[:-1])
        shorter = _LONGEST / max([_LONGEST, *(float(np.linalg.norm(p[3:])) for p in parts if len(p) == 6)])
        for i, h in enumerate(sized):
            model = put_in(h, model, shorter * parts[i])
            totals[i] = composed(h, totals[i], shorter * parts[i])
        now = CheckState(model, state.samples, state.known, state.null)
    found, residual, none = iter(totals), now.view.residual, np.empty(0)
    return [ChangeCandidate(h, residual, now.columns(h), next(found) if h.sizes else none) for h in asked], now


def _set_up(asked: Sequence[CellChange], state: CheckState) -> list[Array]:
    """Sizes to begin from: of base and tool that moved at once those that readings show in closed form, from anywhere,
    unless these leave more than none do.
    """
    still, seen = [np.zeros(h.sizes) for h in asked], np.unique(state.samples.frame)
    samples = state.samples
    if not {BASE, TOOL} <= {h.kind for h in asked} or len(seen) > 1 or not is_direct(samples.kinds):
        return still
    sights, every = SetupReadings.of(state.model, samples), np.arange(len(samples))
    setup = sights.both(every)
    if np.sum(sights.residual(setup) ** 2) > np.sum(sights.residual(sights.setup) ** 2):
        return still
    far = {BASE: setup.D, TOOL: se3.inverse(state.model.T_tip_tool) @ setup.X}
    return [
        error_values(far[h.kind])[: h.sizes] if h.kind in far else none for h, none in zip(asked, still, strict=True)
    ]


def along_one(outside: CellChange, hypothesis: CellChange, state: CheckState) -> CellChange | None:
    """What outside the arm moves, only as a change of one size moves the readings; None where that has more sizes.

    Few stations show one number better than six.
    """
    if hypothesis.sizes != 1 or not outside.motions or outside.together:
        return None
    A, y = (state.null.whitened(state.columns(h)) for h in (outside, hypothesis))
    twist = np.linalg.lstsq(A, y[:, 0], rcond=1e-9)[0] @ np.array([m.twist for m in outside.motions])
    return replace(outside, motions=(replace(outside.motions[0], twist=tuple(twist.tolist())),))

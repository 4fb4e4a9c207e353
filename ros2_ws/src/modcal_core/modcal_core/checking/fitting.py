"""Changes put into the model: fitted together by Gauss-Newton steps, or taken up with their sizes left open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from modcal_core.calibration.model import Model
from modcal_core.checking.evidence import ChangeCandidate, ChangeJudge, JudgedChange, is_noise
from modcal_core.checking.hypotheses import NOISE, CellChange, composed, put_in
from modcal_core.checking.noise import FrozenKnowledge
from modcal_core.checking.state import CheckState
from modcal_core.measurements.samples import Samples

_STEPS = 15  # of a fit; of changes that are small one is enough
_END = 1e-3  # standard deviations, all rows together; the last step of a fit
_LONGEST = 0.5  # rad; a longer turn is taken in parts
_WIDE = 4.0  # times its own size: what a change that was taken up may still be off by


def taken_up(
    model: Model, samples: Samples, known: FrozenKnowledge, picked: Sequence[JudgedChange]
) -> tuple[CheckState, list[ChangeCandidate]]:
    """The state in which these changes have been taken up, their sizes left open, and the changes as fitted."""
    begin = CheckState(model, samples, known)
    if not picked:
        return begin, []
    fits, now = fitted([p.candidate.hypothesis for p in picked], begin, ChangeJudge(begin.null))
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


def fitted(
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

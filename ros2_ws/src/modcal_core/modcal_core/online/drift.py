"""What of an arm changes from one recording to the next: slowly, over weeks, and by how much a week.

The first calibration is the reference. Every later recording is fitted by the same minimal parameters *about* it, so
that all changes are written alike and have covariances (two calibrations of their own may put the same change in
different places). A line through them, weighted by these covariances and by the reference's own, is the drift:

    x_i = a + r t_i + e_i,   e_i ~ (0, C_i);      0 = a + e_0,   e_0 ~ (0, C_0)

Recordings that scatter about the line by more than their covariances say so: those are widened (Birge 1932). Then each
thing that can move, be it base, tool, or a joint's place and zero, is a hypothesis: columns of parameters that move
together. The one that takes most of the rate's chi-square away, its number of columns counted against it, is named,
and it must be more than chance makes of so many hypotheses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from modcal_core.calibration.cell import Cell, refit_cell, with_frames
from modcal_core.calibration.distributions import beyond_chi2
from modcal_core.calibration.identify import identify
from modcal_core.calibration.linearise import linearise
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.calibration.score import errors
from modcal_core.calibration.store import Calibration
from modcal_core.calibration.structure import exact_samples
from modcal_core.calibration.uncertainty import Uncertainty
from modcal_core.errors import BadTable
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.kinds.registry import is_direct
from modcal_core.measurements.samples import Samples
from modcal_core.online.movable import Movable, movables
from modcal_core.plausibility.require import LIMIT_OF_REACH
from modcal_core.robots.mechanism import is_serial_arm

WEEK = 604800.0  # s
SURE = 0.01  # chance of naming something where nothing has changed
_ANYWHERE = 1.0  # m and rad; how far a base or tool that was set up again may be from where it was
_AS_GOOD = 10.0  # difference of the criterion below which two hypotheses are not told apart


@dataclass(frozen=True)
class Change:
    """How the arm of a later recording differs from the reference.

    stamp: the middle of the recording [s]. values (P,), covariance (P, P): of the reference's parameters [m, rad].
    equations: how many the recording gave. base, tool: which of them were found again, so that nothing is said of them.
    """

    stamp: float
    values: Array
    covariance: Array
    equations: int
    base: bool
    tool: bool


@dataclass(frozen=True)
class Drift:
    """A line through the changes of one arm.

    since, until: stamps of the first and the last recording [s]. recordings: how many, the reference included.
    parameters, rate (P,), covariance (P, P): of the reference's parameters, per second. named: what it is that moves;
    None where nothing stands out from noise. size (k,), size_std (k,): its rate along each of its directions, per
    second. p_value: of what was named, or would have been. same_as: names of others that explain it as well.
    """

    since: float
    until: float
    recordings: int
    parameters: tuple[ModelParameter, ...]
    rate: Array
    covariance: Array
    named: Movable | None
    size: Array
    size_std: Array
    p_value: float
    same_as: tuple[str, ...]

    @property
    def std(self) -> Array:
        """Standard deviations of the rates, (P,), per second."""
        return np.sqrt(np.diag(self.covariance))


def change_since(
    reference: Calibration, samples: Samples, refit_base: bool = False, refit_tool: bool = False
) -> Change:
    """How the arm differs in these samples from what the reference says of it; its effects are kept as they are.

    Base and tool are found again where this is asked for, or where the error is larger than an arm's: then something
    was set up again. Raises BadTable for a reference without covariance or of other instruments, NotEnoughData.
    """
    known = reference.uncertainty
    model = reference.calibrated
    if known is None or not is_serial_arm(model.chain) or model.instruments or not is_direct(samples.kind.tolist()):
        raise BadTable(
            "drift of this robot",
            "needs a serial arm, readings of poses or points, and a covariance in the first calibration",
            "compare its calibrations with modcal evaluate",
        )
    chain = model.chain
    strange = not set(samples.frames) <= set(model.frames)
    placed = None if strange else with_frames(model, samples.frames)
    limit = LIMIT_OF_REACH * chain.reach()
    if placed is None or float(np.median(errors(placed, samples).position_norm)) > limit:
        refit_base = refit_tool = True
    if refit_base or refit_tool:
        placed = refit_cell(model, samples, Cell(), refit_base, refit_tool).model
    assert placed is not None
    parameters = _in_frames(known.parameters, model.frames, samples.frames, refit_base)
    fit = identify(placed, samples, [p for _, p in parameters], keep_effects=True)
    P = len(known.parameters)
    values, covariance = np.zeros(P), _ANYWHERE**2 * np.eye(P)
    rows = [i for i, _ in parameters]
    values[rows] = fit.values
    covariance[np.ix_(rows, rows)] = fit.covariance
    free = [m for m in _movables(reference, known) if (refit_base and m.place == "base") or (refit_tool and m.of_tool)]
    for movable in free:
        covariance += _ANYWHERE**2 * movable.columns @ movable.columns.T
    return Change(
        float(0.5 * (samples.stamps.min() + samples.stamps.max())),
        values,
        covariance,
        3 * len(samples) + 3 * int(samples.is_pose.sum()),
        refit_base,
        refit_tool,
    )


def drift(reference: Calibration, changes: Sequence[Change]) -> Drift:
    """The line through the changes of one arm since the reference, and what it is that moves.

    Raises BadTable for a reference without covariance, or without stamps, and for recordings of the same moment.
    """
    known = reference.uncertainty
    if known is None or reference.watched is None:
        raise BadTable("first calibration", "has no covariance or no stamps", "calibrate again")
    start = 0.5 * (reference.watched[0] + reference.watched[1])
    t = np.array([c.stamp - start for c in changes])
    if not len(t) or not (t > 0.0).any():
        raise BadTable("drift", "needs a recording after the first", "record again")
    P = len(known.parameters)
    unit = float(np.abs(t).max())
    H, g = np.zeros((2 * P, 2 * P)), np.zeros(2 * P)
    observed = [(0.0, np.zeros(P), known.covariance[:P, :P]), *(
        (s / unit, c.values, c.covariance) for s, c in zip(t, changes, strict=True)
    )]  # fmt: skip
    weights = [_inverse(C) for _, _, C in observed]
    for (s, d, _), W in zip(observed, weights, strict=True):
        H += np.kron(np.array([[1.0, s], [s, s * s]]), W)
        g += np.r_[W @ d, s * (W @ d)]
    covariance = _inverse(H)
    x = covariance @ g
    freedom = (len(observed) - 2) * P
    rest = [d - x[:P] - s * x[P:] for s, d, _ in observed]
    chi2 = sum(float(e @ W @ e) for e, W in zip(rest, weights, strict=True))
    widened = max(1.0, chi2 / freedom) if freedom > 0 else 1.0
    rate, of_rate = x[P:] / unit, widened * covariance[P:, P:] / unit**2
    until = start + float(t.max())
    return _named(reference, known, changes, rate, of_rate, (start, until))


def _named(
    reference: Calibration,
    known: Uncertainty,
    changes: Sequence[Change],
    rate: Array,
    covariance: Array,
    when: tuple[float, float],
) -> Drift:
    """The drift with the hypothesis that explains the rate best, where one is needed."""
    base, tool = any(c.base for c in changes), any(c.tool for c in changes)
    told = [
        m for m in _movables(reference, known) if not (base and m.place == "base") and not (tool and m.of_tool)
    ]  # fmt: skip
    W = _inverse(covariance)
    penalty = np.log(sum(c.equations for c in changes))
    judged = []
    for movable in told:
        M = movable.columns
        of_size = _inverse(M.T @ W @ M)
        size = of_size @ (M.T @ W @ rate)
        gain = float(size @ M.T @ W @ rate)
        judged.append((gain - penalty * M.shape[1], movable, gain, size, np.sqrt(np.diag(of_size))))
    highest = max(score for score, *_ in judged)
    # of those that cannot be told apart base and tool are named before the joints that would move alike
    as_good = sorted((j for j in judged if j[0] > highest - _AS_GOOD), key=lambda j: (j[1].of_arm, -j[0]))
    _, best, gain, size, std = as_good[0]
    p_value = min(1.0, len(judged) * beyond_chi2(gain, best.columns.shape[1]))
    sure = p_value < SURE
    rivals = tuple(m.name for _, m, _, _, _ in as_good[1:] if not _part_of(best, m))
    return Drift(
        *when,
        1 + len(changes),
        known.parameters,
        rate,
        covariance,
        best if sure else None,
        size,
        std,
        p_value,
        rivals if sure else (),
    )


def _part_of(one: Movable, other: Movable) -> bool:
    """Whether the two are the same place moving in fewer and in more directions."""
    return one.place == other.place and bool(set(one.directions) & set(other.directions))


def _movables(reference: Calibration, known: Uncertainty) -> list[Movable]:
    """What can move, in columns of the reference's parameters, as its postures show it."""
    model = reference.calibrated
    q = reference.postures
    frames = np.arange(len(q)) % len(model.frames)
    exact = exact_samples(model, q, frames, np.array([reference.kind] * len(q), dtype="U8"))
    return movables(model.serial, model.frames, lambda parameters: _rows(model, parameters, exact), known.parameters)


def _rows(model: Model, parameters: Sequence[ModelParameter], samples: Samples) -> Array:
    bare = replace(model, effects=(), leaders=())
    return linearise(bare, parameters, np.zeros(len(parameters)), samples).J


def _in_frames(
    parameters: Sequence[ModelParameter], frames: Sequence[str], now: Sequence[str], strange: bool
) -> list[tuple[int, ModelParameter]]:
    """The parameters with their numbers, as the frames are ordered now; those of frames that are gone are left out.

    strange: the frames were found again, and may have other names: the first is taken for the first.
    """
    out = []
    for i, p in enumerate(parameters):
        if p.frame < 0:
            out.append((i, p))
        elif frames[p.frame] in now:
            out.append((i, replace(p, frame=now.index(frames[p.frame]))))
        elif strange and p.frame < len(now):
            out.append((i, p))
    return out


def _inverse(A: Array) -> Array:
    """Inverse of a symmetric positive matrix, scaled to a unit diagonal; a pseudo-inverse where it is singular."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-300))
    S = A * np.outer(scale, scale)
    try:
        inverse = cho_solve(cho_factor(S, lower=True), np.eye(len(S)))
    except np.linalg.LinAlgError:
        inverse = np.asarray(np.linalg.pinv(S, rcond=1e-12, hermitian=True), dtype=float)
    return 0.5 * (inverse + inverse.T) * np.outer(scale, scale)

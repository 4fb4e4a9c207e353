"""Offsets of the joints, as a technician masters an arm, and the difference of two calibrations at the tool.

Base and tool are other ones in every session. So the tool is predicted by both models at the postures of both
recordings, one model's base and tool are fitted to the other's, and what then is left is compared with what two
calibrations of the same arm would differ by: draws from the covariance of both, treated the same way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import (
    Calibration,
    ErrorSize,
    Model,
    ModelParameter,
    Uncertainty,
    exact_samples,
    linearise,
    outside_drivers,
)
from modcal_core.geometry import Array, so3
from modcal_core.measurements import POSE, Samples, spread_rows
from modcal_core.measurements.kinds import KIND_NAMES
from modcal_core.robots import is_serial_arm

_SAME = 1e-9  # of the largest singular value; smaller ones are rounding


def twists(T: Array, to: Array) -> Array:
    """Small motions (N, 6) that take poses T (N, 4, 4) to others, as the base sees them: shift at the tool, turn."""
    turn = so3.log(to[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2))
    return np.c_[to[:, :3, 3] - T[:, :3, 3], turn]


def base_and_tool_motions(T: Array, turns: bool) -> Array:
    """What small motions of base and tool do at poses T, (N, 6, 12); of positions alone (N, 3, 12)."""
    out = np.zeros((len(T), 6, 12))
    out[:, :3, :3] = out[:, 3:, 3:6] = np.eye(3)
    out[:, :3, 3:6] = -so3.hat(T[:, :3, 3])  # the base turns about its origin
    out[:, :3, 6:9] = out[:, 3:, 9:12] = T[:, :3, :3]
    return out if turns else out[:, :3]


def poses_at(model: Model, q: Array) -> Samples:
    """Samples of poses at postures q (N, n) in the model's first frame."""
    return exact_samples(model, q, np.zeros(len(q), int), np.full(len(q), POSE, dtype=KIND_NAMES))


def parameter_motions(
    model: Model, parameters: Sequence[ModelParameter], q: Array, effect_values: Array | None = None
) -> Array:
    """What each of K parameters, then effect values, does at the tool at postures q (N, n): ``twists``, (K, N, 6)."""
    values = np.zeros(len(parameters))
    values = values if effect_values is None else np.concatenate([values, effect_values])
    J = linearise(model, tuple(parameters), values, poses_at(model, q)).J
    R = model.chain.T_base_root[:3, :3]
    parts = J.reshape(len(J), 2, 3, -1)
    return np.asarray(np.einsum("ij,kpjn->knpi", R, parts).reshape(len(J), parts.shape[-1], 6))


def without(motions: Array, taken: Array) -> Array:
    """Motions (..., N, 6 or 3) less what base and tool can take up (N, 6 or 3, 12); 1 rad counts as much as 1 m."""
    rows = taken.shape[0] * taken.shape[1]
    flat = motions.reshape(*motions.shape[:-2], rows)
    basis, size, _ = np.linalg.svd(taken.reshape(rows, -1), full_matrices=False)
    kept = basis[:, size > _SAME * size[0]]
    return np.asarray((flat - (flat @ kept) @ kept.T).reshape(motions.shape))


NORMAL = 1.96  # deviations of a 95 % interval
_MAX = 200  # postures; offsets are constant, and more say the same
_STEP = 1e-6  # rad or m, of a difference quotient
_TAKEN_UP = 1e-3  # of a joint's motion at the tool, that is left when base and tool were fitted: rounding, no offset


@dataclass(frozen=True)
class JointOffset:
    """Offset of one joint with its standard deviation [rad; m for a sliding joint], over recordings of similar
    postures; std is None where the fit's uncertainty is not known.
    """

    joint: str
    value: float
    std: float | None
    turning: bool

    @property
    def ci95(self) -> tuple[float, float] | None:
        """95 % interval of the value [rad, m]; None where it is not known."""
        return None if self.std is None else (self.value - NORMAL * self.std, self.value + NORMAL * self.std)


@dataclass(frozen=True)
class JointOffsets:
    """found: those that are determined, in the order of the chain. nominal_mm, left_mm: RMS at the tool between nominal
    and calibrated geometry without and with the offsets, base and tool fitted.
    """

    found: tuple[JointOffset, ...]
    nominal_mm: float
    left_mm: float


def offsets_of(calibration: Calibration) -> JointOffsets | None:
    """Joint offsets of a calibration at the postures it was made from, whatever it is evaluated on."""
    turns, known = calibration.kind == "pose", calibration.uncertainty
    return joint_offsets(calibration.calibrated, calibration.postures, turns, known)


def joint_offsets(model: Model, q: Array, turns: bool, known: Uncertainty | None = None) -> JointOffsets | None:
    """Joint offsets of a calibrated model at postures q (N, n) [rad, m]; None for a Delta, or where the nominal arm is
    not known.

    turns: whether the tool's orientation counts, as its position does. known: the uncertainty of the parameters.
    """
    if model.arm is None or not is_serial_arm(model.chain) or not is_serial_arm(model.arm.chain) or not len(q):
        return None
    q = q[spread_rows(len(q), _MAX)]
    part = slice(6 if turns else 3)
    bare = replace(model, effects=(), T_frame_base=np.tile(np.eye(4), (len(model.frames), 1, 1)), instruments=())
    nominal = bare.with_chain(model.arm.chain)
    T = nominal.predict(q)
    taken = base_and_tool_motions(T, part.stop == 6)
    apart = without(twists(T, bare.predict(q))[:, part], taken)
    moved = np.stack([twists(T, nominal.predict(q + _STEP * row))[:, part] / _STEP for row in np.eye(q.shape[1])])
    own = without(moved, taken)
    seen = np.linalg.norm(own, axis=(1, 2)) > _TAKEN_UP * np.linalg.norm(moved, axis=(1, 2))
    if not seen.any():
        return None
    J = own[seen].reshape(int(seen.sum()), -1).T
    to_offsets = np.linalg.pinv(J, rcond=1e-6)
    values = to_offsets @ apart.ravel()
    left = apart - (J @ values).reshape(apart.shape)
    std = _deviations(bare, q, known, taken, to_offsets, left)
    return JointOffsets(
        tuple(
            JointOffset(model.chain.names[j], float(values[k]), std[k], bool(model.chain.revolute[j]))
            for k, j in enumerate(np.flatnonzero(seen))
        ),
        _rms_mm(apart),
        _rms_mm(left),
    )


def _deviations(
    bare: Model, q: Array, known: Uncertainty | None, taken: Array, to_offsets: Array, left: Array
) -> list[float | None]:
    """Standard deviations of the offsets: of the fit's parameters of arm and tool, and of the choice of postures.

    taken, left: (N, 6 or 3, 12) and (N, 6 or 3). to_offsets: from differences to offsets (k, rows).
    """
    rows = [] if known is None else [k for k, p in enumerate(known.parameters) if p.frame < 0 and p.instrument < 0]
    if known is None or not rows:
        return [None] * len(to_offsets)
    count, of_each = left.shape
    motions = parameter_motions(bare, [known.parameters[k] for k in rows], q)[..., :of_each]
    A = to_offsets @ without(motions, taken).reshape(len(rows), -1).T
    of_fit = np.einsum("ij,jk,ik->i", A, known.covariance[np.ix_(rows, rows)], A)
    pulls = np.einsum("knr,nr->kn", to_offsets.reshape(-1, count, of_each), left)
    free = left.size - len(to_offsets) - taken.shape[-1]
    if free < 1 or count < 2:
        return [None] * len(to_offsets)
    of_postures = np.sum(pulls**2, axis=1) * count / (count - 1.0) * (left.size - 1.0) / free
    return [float(x) for x in np.sqrt(of_fit + of_postures)]


def _rms_mm(motions: Array) -> float:
    return 1e3 * float(np.sqrt(np.mean(np.sum(motions[:, :3] ** 2, axis=1))))


_MAX_POSTURES = 300  # postures; the differences are smooth, and more say the same
_DRAWS = 1000  # of the covariances; the 95 % quantile then has 50 above it
_TAIL = 0.05  # of the draws
_OWN = 0.02  # of what a parameter moves the tool by; less is the tilt of a calibrated axis against the nominal one


@dataclass(frozen=True)
class ToolDifference:
    """What the two models differ by at the tool, second less first, in the arm's base.

    q: postures (N, n). size_mm, size_deg: of the difference, base and tool fitted to each other; size_deg is None for
    readings without orientations. as_they_are_mm: of the arms from base link to tip, nothing fitted. expected_mm: what
    the uncertainty of both explains, 95 % quantile of the RMS; None where one of them does not keep its uncertainty.
    left_out: effects of either that postures alone do not determine. of_base_or_tool: parameters that base and tool
    can take up, so that their values may differ between sessions and the arm be the same.
    """

    q: Array
    size_mm: ErrorSize
    size_deg: ErrorSize | None
    as_they_are_mm: ErrorSize
    expected_mm: float | None
    left_out: tuple[str, ...]
    of_base_or_tool: frozenset[str] = frozenset()


def tool_difference(first: Calibration, second: Calibration) -> ToolDifference | None:
    """Difference of two calibrations at the tool; None where neither keeps its postures."""
    kept = [c.postures for c in (first, second) if len(c.postures)]
    if not kept:
        return None
    q = np.concatenate(kept)
    q = q[spread_rows(len(q), _MAX_POSTURES)]
    turns = first.kind == second.kind == "pose"
    (one, left_one), (two, left_two) = _standing(first), _standing(second)
    # one tool for both, so that the point that is compared is the same on the arm
    models = (one, replace(two, T_tip_tool=one.T_tip_tool))
    T, tips = (
        [replace(m, T_tip_tool=tool).predict_samples(poses_at(m, q)) for m in models]
        for tool in (one.T_tip_tool, np.eye(4))
    )
    taken = base_and_tool_motions(T[0], turns)
    left = without(twists(*T)[:, : taken.shape[1]], taken)
    uncertain = [_uncertain(c, m, q, taken) for c, m in zip((first, second), models, strict=True) if c.uncertainty]
    return ToolDifference(
        q=q,
        size_mm=_size(1e3 * left[:, :3]),
        size_deg=_size(np.degrees(left[:, 3:])) if turns else None,
        as_they_are_mm=_size(1e3 * (tips[1] - tips[0])[:, :3, 3]),
        expected_mm=_expected(uncertain) if len(uncertain) == 2 else None,
        left_out=tuple(dict.fromkeys((*left_one, *left_two))),
        of_base_or_tool=uncertain[0].taken_up if first.uncertainty else frozenset(),
    )


def _size(left: Array) -> ErrorSize:
    size = ErrorSize.of(np.linalg.norm(left, axis=1))
    assert size is not None
    return size


def _standing(calibration: Calibration) -> tuple[Model, tuple[str, ...]]:
    """The calibrated model in its base, with the effects that a posture alone determines; names of the others."""
    model = calibration.calibrated
    kept = tuple(e for e in model.effects if not outside_drivers(e))
    others = tuple(e.label for e in model.effects if outside_drivers(e))
    frames = np.tile(np.eye(4), (len(model.frames), 1, 1))
    return replace(model.with_effects(kept), T_frame_base=frames, instruments=()), others


@dataclass(frozen=True)
class _Uncertain:
    """What K parameters of a calibration move at the tool, base and tool fitted (K, N, 3) [m], and their covariance.

    taken_up: names of those that change nothing which base and tool could not.
    """

    motions: Array
    covariance: Array
    taken_up: frozenset[str]


def _uncertain(calibration: Calibration, model: Model, q: Array, taken: Array) -> _Uncertain:
    known = calibration.uncertainty
    assert known is not None
    index = [k for k, p in enumerate(known.parameters) if p.instrument < 0]
    parameters, here = tuple(known.parameters[k] for k in index), len(known.parameters)
    for effect in calibration.calibrated.effects:
        index += range(here, here + len(effect.values)) if not outside_drivers(effect) else ()
        here += len(effect.values)
    of_effects = np.concatenate([np.empty(0), *(e.values for e in model.effects)])
    moved = parameter_motions(model, parameters, q, of_effects)[..., : taken.shape[1]]
    left = without(moved, taken)
    sizes = np.linalg.norm(left, axis=(1, 2)), np.linalg.norm(moved, axis=(1, 2))
    taken_up = frozenset(p.name for p, rest, whole in zip(parameters, *sizes, strict=False) if rest < _OWN * whole)
    return _Uncertain(left[..., :3], known.covariance[np.ix_(index, index)], taken_up)


def _expected(both: Sequence[_Uncertain]) -> float:
    """The 95 % quantile [mm] of the RMS that two calibrations of the same arm, as sure as these, would differ by."""
    rng, moved = np.random.default_rng(0), []  # the same calibrations give the same bytes
    for one in both:
        size, axes = np.linalg.eigh(one.covariance)
        draws = rng.standard_normal((_DRAWS, len(size))) * np.sqrt(np.maximum(size, 0.0)) @ axes.T
        moved.append(np.tensordot(draws, one.motions, 1))
    rms = np.sqrt(np.mean(np.sum(sum(moved) ** 2, axis=-1), axis=-1))
    return 1e3 * float(np.quantile(rms, 1.0 - _TAIL))

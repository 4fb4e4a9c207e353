"""Offsets of the joints, as a technician masters an arm: what added to the reported positions brings the nominal arm
nearest to the calibrated one, base and tool being free.

A fit has no such parameters of its own: a turn about a joint's axis passes through the joint and is seen at the next
place, so that it stands in several of them. An offset that base or tool can take up, mostly of the first and the last
joint, is not determined and left out.

How sure an offset is has two parts. The covariance of the fit: what its parameters do at the tool is projected on the
offsets as the difference itself is. And the postures: offsets alone do not make one arm of the other, so that what is
nearest over these postures is another than over others like them. That part is the sandwich estimator of least squares
with a posture as the unit (Liang & Zeger 1986), with the usual factor for small numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import Calibration, Model, ModelParameter, Uncertainty, exact_samples, linearise
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
    """Joint offsets of a calibration at the postures it was made from, so they do not depend on what it is evaluated
    on.
    """
    return joint_offsets(
        calibration.calibrated, calibration.postures, calibration.kind == "pose", calibration.uncertainty
    )


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

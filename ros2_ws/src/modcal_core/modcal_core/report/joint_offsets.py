"""Offsets of the joints, as a technician masters an arm: what added to the reported positions brings the nominal arm
nearest to the calibrated one, base and tool being free.

A fit has no such parameters of its own: a turn about a joint's axis passes through the joint and is seen at the next
place, so that it stands in several of them. An offset that base or tool can take up, mostly of the first and the last
joint, is not determined and left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration.model import Model
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_core.report.base_and_tool import base_and_tool_motions, twists, without
from modcal_core.robots.mechanism import is_serial_arm

_MOST = 200  # postures; offsets are constant, and more say the same
_STEP = 1e-6  # rad or m, of a difference quotient
_TAKEN_UP = 1e-3  # of a joint's motion at the tool, that is left when base and tool were fitted: rounding, no offset


@dataclass(frozen=True)
class JointOffsets:
    """turning: names and offsets [deg]; sliding: the same [mm]. nominal_mm, left_mm: RMS at the tool between nominal
    and calibrated geometry without and with the offsets, base and tool fitted.
    """

    turning: tuple[tuple[str, float], ...]
    sliding: tuple[tuple[str, float], ...]
    nominal_mm: float
    left_mm: float


def joint_offsets(model: Model, samples: Samples) -> JointOffsets | None:
    """Of a calibrated model at the samples' postures; None for a Delta, or where the nominal arm is not known."""
    if model.arm is None or not is_serial_arm(model.chain) or not is_serial_arm(model.arm.chain) or not len(samples):
        return None
    q = samples.q[np.unique(np.linspace(0, len(samples) - 1, min(len(samples), _MOST)).astype(int))]
    turns = bool(samples.is_pose.all())
    part = slice(6 if turns else 3)
    bare = replace(model, effects=(), T_frame_base=np.eye(4)[None])
    nominal = bare.with_chain(model.arm.chain)
    T = nominal.predict(q)
    taken = base_and_tool_motions(T, turns)
    apart = without(twists(T, bare.predict(q))[:, part], taken)
    moved = np.stack([twists(T, nominal.predict(q + _STEP * row))[:, part] / _STEP for row in np.eye(q.shape[1])])
    own = without(moved, taken)
    known = np.linalg.norm(own, axis=(1, 2)) > _TAKEN_UP * np.linalg.norm(moved, axis=(1, 2))
    if not known.any():
        return None
    J = own[known].reshape(int(known.sum()), -1).T
    values = np.linalg.lstsq(J, apart.ravel(), rcond=1e-6)[0]
    left = apart - (J @ values).reshape(apart.shape)
    found = [(j, value) for j, value in zip(np.flatnonzero(known), values, strict=True)]
    names, turning = model.chain.names, model.chain.revolute
    return JointOffsets(
        tuple((names[j], float(np.degrees(value))) for j, value in found if turning[j]),
        tuple((names[j], 1e3 * float(value)) for j, value in found if not turning[j]),
        _rms_mm(apart),
        _rms_mm(left),
    )


def _rms_mm(motions: Array) -> float:
    return 1e3 * float(np.sqrt(np.mean(np.sum(motions[:, :3] ** 2, axis=1))))

"""A model held at one set of values, and what single samples say of it: the quick way to residual and derivatives.

:func:`~modcal_core.calibration.linearise.linearise` puts the values in anew for every call, which pays for thousands of
samples at once. Here that is done once, and a sample costs one pass along the chain and a few small products.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import asin, sqrt

import numpy as np

from modcal_core.calibration.effects import all_columns, motion
from modcal_core.calibration.linearise import View, deviations, local_twists, model_at
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import INSTRUMENT, Parameter
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_core.robots.kinematics import frames


class Frozen:
    """Residual and derivatives of single samples at these values of a model's parameters and effects."""

    def __init__(self, start: Model, parameters: Sequence[Parameter], values: Array) -> None:
        """values: of the parameters, and behind them those of the effects; left out, effects stay as they are."""
        now = model_at(start, parameters, values)
        errors = deviations(start, parameters, values[: len(parameters)])
        of_frames, of_places = local_twists(errors.frames), local_twists(errors.places)
        twists = np.zeros((len(parameters), 6))
        for j, p in enumerate(parameters):
            if p.place == INSTRUMENT:
                continue  # of an instrument whose readings do not come here: nothing moves with it
            twists[j] = (of_places[p.place - 1] if p.place else of_frames[p.frame])[p.direction]
        self._model = now
        self._effects = len(values) > len(parameters)
        self._shift, self._turn = twists[:, :3, None], twists[:, 3:, None]
        self._turning = so3.hat(twists[:, 3:])
        self._place = np.array([max(p.place, 0) for p in parameters], dtype=int)
        self._frame = np.array([p.frame for p in parameters], dtype=int)
        chain = now.serial
        T_base_root = chain.T_base_root
        self._T_root_frame = se3.inverse(now.T_frame_base @ T_base_root)
        rooted = np.array(chain.origins)
        rooted[0] = se3.inverse(se3.transform(chain.joint_basis[0]))
        rooted[-1] = rooted[-1] @ now.T_tip_tool
        self._chain = chain.with_origins(rooted)
        self._constants = self._chain.along_z
        self._joints = np.tile(np.eye(4), (chain.n, 1, 1))

    def __call__(self, sample: Samples) -> tuple[Array, Array]:
        """(residual (3,) or (6,): position [m] then rotation [rad], its negative derivative (3 or 6, P)) of one row."""
        if not self._model.effects:
            return self._of_geometry(sample)
        at = self._model.circumstances(sample)
        twists, scale = motion(self._model.effects, at)
        f = frames(self._chain, sample.q, twists)
        T_root_place = np.concatenate([f.transform(k) for k in range(len(f.p))])
        residual, J, reading = self._seen(sample, T_root_place, float(scale[0]))
        if self._effects:
            position, rotation = residual[:3, None], residual[3:, None].reshape(3, -1)
            view = View(sample, np.flatnonzero(sample.is_pose), f, position, rotation, reading[:, None])
            more = [view.moved_by(terms) for terms in all_columns(self._model.effects, at)]
            J = np.concatenate([J, np.stack(more, axis=1)], axis=1)
        return residual, J

    def _of_geometry(self, sample: Samples) -> tuple[Array, Array]:
        """The same for an arm without effects: for one posture, products of 4 × 4 matrices are the least work."""
        joints, q, revolute = self._joints, sample.q[0], self._chain.revolute
        c, s = np.cos(q), np.sin(q)
        joints[revolute, 0, 0] = joints[revolute, 1, 1] = c[revolute]
        joints[revolute, 1, 0] = s[revolute]
        joints[revolute, 0, 1] = -s[revolute]
        joints[~revolute, 2, 3] = q[~revolute]
        steps = joints @ self._constants[1:]
        T = np.empty((len(steps) + 1, 4, 4))
        T[0] = self._constants[0]
        for k, step in enumerate(steps):
            np.matmul(T[k], step, out=T[k + 1])
        residual, J, _ = self._seen(sample, T, 1.0)
        return residual, J

    def _seen(self, sample: Samples, T_root_place: Array, scale: float) -> tuple[Array, Array, Array]:
        """(residual, J of the geometry, what was read as seen from the root) with the places' frames (n + 1, 4, 4)."""
        frame, pose = int(sample.frame[0]), bool(sample.is_pose[0])
        T = self._T_root_frame[frame]
        reading = T[:3, :3] @ (sample.position[0] / scale)
        R, p = T_root_place[:, :3, :3], T_root_place[:, :3, 3]
        residual = reading + T[:3, 3] - p[-1]
        # a twist (v, ω) moves the tool by R (v + ω × t), t being the tool in the frame of its place
        t = (p[-1] - p)[:, None] @ R
        J = np.empty((len(self._place), 3, 1 + pose))
        J[:, :, :1] = self._turning @ t[self._place].transpose(0, 2, 1) + self._shift
        if pose:
            J[:, :, 1:] = self._turn
            residual = np.concatenate([residual, small_log(T[:3, :3] @ sample.R[0] @ R[-1].T)])
        J = (R[self._place] @ J).transpose(2, 1, 0).reshape(-1, len(self._place))
        if len(self._T_root_frame) > 1:
            here = (self._frame == frame) | (self._frame == self._model.leader(frame))
            J[:, (self._place == 0) & ~here] = 0.0
        return residual, J, reading


def small_log(R: Array) -> Array:
    """Rotation vector (3,) [rad] of one rotation (3, 3), which is meant to be small: then without a quaternion."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    x, y, z = 0.5 * (h - f), 0.5 * (c - g), 0.5 * (d - b)
    sine = sqrt(x * x + y * y + z * z)
    if sine > 0.5 or a + e + i < 1.0:
        return so3.log(R)
    scale = asin(sine) / sine if sine > 1e-8 else 1.0
    return np.array([scale * x, scale * y, scale * z])

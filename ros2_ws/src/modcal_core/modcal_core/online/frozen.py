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
from modcal_core.geometry.so3 import HAT, Array
from modcal_core.measurements.samples import Samples
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import frames


class Frozen:
    """Residual and derivatives of single samples at these values of a model's parameters and effects."""

    def __init__(self, start: Model, parameters: Sequence[Parameter], values: Array) -> None:
        """values: of the parameters, and behind them those of the effects; left out, effects stay as they are."""
        now = model_at(start, parameters, values)
        errors = deviations(start, parameters, values[: len(parameters)])
        of_frames, of_places = local_twists(errors.frames), local_twists(errors.places)
        places = max([0, *(p.place for p in parameters)]) + 1
        self._twists = np.zeros((places, 6, len(parameters)))
        for j, p in enumerate(parameters):
            if p.place == INSTRUMENT:
                continue  # of an instrument whose readings do not come here: nothing moves with it
            twist = (of_places[p.place - 1] if p.place else of_frames[p.frame])[p.direction]
            self._twists[p.place, :, j] = twist
        self._model = now
        self._effects = len(values) > len(parameters)
        chain = now.serial
        self._unseen = [_unseen(now, parameters, frame) for frame in range(len(now.frames))]
        self._T_root_frame = se3.inverse(now.T_frame_base @ chain.T_base_root)
        rooted = np.array(chain.origins)
        rooted[0] = se3.inverse(se3.transform(chain.joint_basis[0]))
        rooted[-1] = rooted[-1] @ now.T_tip_tool
        self._chain = chain.with_origins(rooted)
        self._steps = _steps(self._chain)

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
        q = sample.q[0]
        parts = np.ones((len(q), 1, 4))
        parts[:, 0, 1], parts[:, 0, 2], parts[:, 0, 3] = np.cos(q), np.sin(q), q
        steps = (parts @ self._steps).reshape(-1, 4, 4)
        T = np.empty((len(steps) + 1, 4, 4))
        T[0] = self._chain.along_z[0]
        for k, step in enumerate(steps):
            np.dot(T[k], step, out=T[k + 1])
        residual, J, _ = self._seen(sample, T, 1.0)
        return residual, J

    def _seen(self, sample: Samples, T_root_place: Array, scale: float) -> tuple[Array, Array, Array]:
        """(residual, J of the geometry, what was read as seen from the root) with the places' frames (n + 1, 4, 4)."""
        frame, pose = int(sample.frame[0]), bool(sample.is_pose[0])
        T = self._T_root_frame[frame]
        reading = T[:3, :3] @ (sample.position[0] / scale)
        R, p = T_root_place[:, :3, :3], T_root_place[:, :3, 3]
        residual = reading + T[:3, 3] - p[-1]
        # a twist (v, ω) of a place moves the tool by R v + (R ω) × t, t being the way from there to the tool
        places = len(self._twists)
        rows = np.zeros((3 + 3 * pose, places, 6))
        rows[:3, :, :3] = R[:places].transpose(1, 0, 2)
        rows[:3, :, 3:] = (((p[:places] - p[-1]) @ HAT).reshape(-1, 3, 3) @ R[:places]).transpose(1, 0, 2)
        if pose:
            rows[3:, :, 3:] = rows[:3, :, :3]
            residual = np.concatenate([residual, small_log(T[:3, :3] @ sample.R[0] @ R[-1].T)])
        J = rows.reshape(len(rows), -1) @ self._twists.reshape(6 * places, -1)
        J[:, self._unseen[frame]] = 0.0
        return residual, J, reading


def _unseen(model: Model, parameters: Sequence[Parameter], frame: int) -> Array:
    """Which parameters (m,) are of another frame that does not lead this one, so that readings in it say nothing."""
    with_it = (frame, model.leader(frame))
    return np.array([j for j, p in enumerate(parameters) if p.place == 0 and p.frame not in with_it], dtype=int)


def _steps(chain: Chain) -> Array:
    """From each place to the next, what is constant and what goes with cos q, sin q and q; flat, (n, 4, 16)."""
    motions = np.zeros((chain.n, 4, 4, 4))
    motions[:, 0] = np.eye(4)
    for terms, turns in zip(motions, chain.revolute, strict=True):
        if turns:  # Rz(q)
            terms[0, 0, 0] = terms[0, 1, 1] = 0.0
            terms[1, 0, 0] = terms[1, 1, 1] = terms[2, 1, 0] = 1.0
            terms[2, 0, 1] = -1.0
        else:
            terms[3, 2, 3] = 1.0
    return np.asarray(motions @ chain.along_z[1:, None]).reshape(chain.n, 4, 16)


def small_log(R: Array) -> Array:
    """Rotation vector (3,) [rad] of one rotation (3, 3), which is meant to be small: then without a quaternion."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    x, y, z = 0.5 * (h - f), 0.5 * (c - g), 0.5 * (d - b)
    sine = sqrt(x * x + y * y + z * z)
    if sine > 0.5 or a + e + i < 1.0:
        return so3.log(R)
    scale = asin(sine) / sine if sine > 1e-8 else 1.0
    return np.array([scale * x, scale * y, scale * z])

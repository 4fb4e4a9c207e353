"""A model held at one set of values, and what single samples say of it: the quick way to residual and derivatives.

:func:`~modcal_core.calibration.linearise.linearise` puts the values in anew for every call, which pays for thousands of
samples at once. Here that is done once, and a sample costs one pass along the chain and a few small products.
"""

from __future__ import annotations

from collections.abc import Sequence

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
        self._place = np.array([max(p.place, 0) for p in parameters], dtype=int)
        self._frame = np.array([p.frame for p in parameters], dtype=int)
        chain = now.serial
        T_base_root = chain.T_base_root
        self._T_root_frame = se3.inverse(now.T_frame_base @ T_base_root)
        rooted = np.array(chain.origins)
        rooted[0] = se3.inverse(se3.transform(chain.joint_basis[0]))
        rooted[-1] = rooted[-1] @ now.T_tip_tool
        self._chain = chain.with_origins(rooted)

    def __call__(self, sample: Samples) -> tuple[Array, Array]:
        """(residual (3,) or (6,): position [m] then rotation [rad], its negative derivative (3 or 6, P)) of one row."""
        at = self._model.circumstances(sample)
        twists, scale = motion(self._model.effects, at) if self._model.effects else ({}, np.ones(1))
        f = frames(self._chain, sample.q, twists)
        frame, pose = int(sample.frame[0]), bool(sample.is_pose[0])
        T = self._T_root_frame[frame]
        reading = T[:3, :3] @ (sample.position[0] / scale[0])
        position = reading + T[:3, 3] - f.p[-1, :, 0]
        R = f.axes[:, :, :, 0].transpose(0, 2, 1)[self._place]  # (P, 3, 3), columns are the directions of each place
        turn = (R @ self._turn)[..., 0]
        lever = f.p[-1, :, 0] - f.p[self._place, :, 0]
        shift = (R @ self._shift)[..., 0]
        shift[:, 0] += turn[:, 1] * lever[:, 2] - turn[:, 2] * lever[:, 1]
        shift[:, 1] += turn[:, 2] * lever[:, 0] - turn[:, 0] * lever[:, 2]
        shift[:, 2] += turn[:, 0] * lever[:, 1] - turn[:, 1] * lever[:, 0]
        rows = [shift.T, turn.T] if pose else [shift.T]
        residual = [position]
        rotation = np.zeros((3, int(pose)))
        if pose:
            R_tool = f.axes[-1, :, :, 0].T
            rotation[:, 0] = so3.log(T[:3, :3] @ sample.R[0] @ R_tool.T)
            residual.append(rotation[:, 0])
        J = np.concatenate(rows)
        if len(self._T_root_frame) > 1:
            here = (self._frame == frame) | (self._frame == self._model.leader(frame))
            J[:, (self._place == 0) & ~here] = 0.0
        if self._effects:
            view = View(sample, np.flatnonzero(sample.is_pose), f, position[:, None], rotation, reading[:, None])
            more = [view.moved_by(terms) for terms in all_columns(self._model.effects, at)]
            J = np.concatenate([J, np.stack(more, axis=1)], axis=1)
        return np.concatenate(residual), J

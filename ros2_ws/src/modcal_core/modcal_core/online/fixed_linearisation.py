"""A model held at one set of values, and what single samples say of it: the quick way to residual and derivatives.

:func:`~modcal_core.calibration.linearise` inserts the values again in every call, which pays for thousands of samples
at once. Here that is done once, and a sample costs one pass along the chain and a few small products.

What a place does to the tool is first seen at the root's origin: the adjoint matrix of the place's frame carries its
twists there, and the way from there to the tool is the same for all.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.calibration import (
    INSTRUMENT,
    Deviations,
    Model,
    ModelParameter,
    NoiseModel,
    RowView,
    deviations,
    geometry_rows,
    model_at,
)
from modcal_core.effects import all_columns, motion
from modcal_core.geometry import HAT, Array, local_twists, se3, so3
from modcal_core.measurements import Samples
from modcal_core.robots import Chain, frames, is_serial_arm

_EYE = np.eye(6)


class FixedLinearisation:
    """Residual and derivatives of single samples at these values of a model's parameters and effects."""

    def __init__(self, start: Model, parameters: Sequence[ModelParameter], values: Array) -> None:
        """values: of the parameters, and behind them those of the effects; left out, effects stay as they are."""
        now = self._model = model_at(start, parameters, values)
        self._start, self._parameters, self._values = start, parameters, values
        self._effects = len(values) > len(parameters)
        self._chain: Chain | None = None
        if not is_serial_arm(now.chain):  # of closed chains nothing can be carried from joint to joint
            return
        errors, chain = deviations(start, parameters, values[: len(parameters)]), now.serial
        self._twists = [_twists(now, parameters, errors, frame) for frame in range(len(now.frames))]
        self._T_root_frame = se3.inverse(now.T_frame_base @ chain.T_base_root)
        rooted = np.array(chain.origins)
        rooted[0] = se3.inverse(se3.transform(chain.joint_basis[0]))
        rooted[-1] = rooted[-1] @ now.T_tip_tool
        self._chain = chain.with_origins(rooted)

    def __call__(self, sample: Samples) -> tuple[Array, Array]:
        """(residual (3,) or (6,): position [m] then rotation [rad], its negative derivative (3 or 6, P)) of one row."""
        at, pose = self._model.drivers(sample), np.flatnonzero(sample.is_pose)
        if self._chain is None:
            view = RowView.of(self._model, sample, at)
            J = geometry_rows(view, self._start, self._parameters, self._values)
        else:
            twists, scale = motion(self._model.effects, at)
            f = frames(self._chain, sample.q, twists)
            T = np.concatenate([f.transform(k) for k in range(len(f.p))])
            T_root_frame, p = self._T_root_frame[sample.frame[0]], T[-1, :3, 3]
            R_root_frame = T_root_frame[:3, :3]
            reading = R_root_frame @ (sample.reading[0] / scale[0])
            turned = so3.log(R_root_frame @ sample.R[pose] @ T[-1, :3, :3].T)
            view = RowView(
                sample, pose, f, (reading + T_root_frame[:3, 3] - p)[:, None], turned.reshape(-1, 3).T, reading[:, None]
            )
            to_tool = _EYE.copy()
            to_tool[3:, :3] = (p @ HAT).reshape(3, 3)
            towards = np.swapaxes(se3.adjoint(T), -1, -2).reshape(-1, 6)  # from each place, seen at the root's origin
            J = self._twists[sample.frame[0]] @ towards @ to_tool[:, : 6 if len(pose) else 3]
        if self._effects:
            J = np.concatenate([J, *(view.moved_by(terms)[None] for terms in all_columns(self._model.effects, at))])
        return view.residual, J.T


def _twists(now: Model, parameters: Sequence[ModelParameter], errors: Deviations, frame: int) -> Array:
    """The twist per unit of each parameter in the frame of its place, (P, 6 (n + 1)); for readings in a frame."""
    of_frames, of_places = local_twists(errors.frames), local_twists(errors.places)
    out = np.zeros((len(parameters), now.serial.n + 1, 6))
    with_it = (frame, now.leader(frame))
    for j, p in enumerate(parameters):
        if p.place == INSTRUMENT:
            continue  # of an instrument whose readings do not come here: nothing moves with it
        if p.place:
            out[j, p.place] = of_places[p.place - 1][p.direction]
        elif p.frame in with_it:  # of a frame that does not lead this one, readings in this one say nothing
            out[j, 0] = of_frames[p.frame][p.direction]
    return out.reshape(len(parameters), -1)


def spread(noise: NoiseModel, sample: Samples) -> Array:
    """Standard deviations of the rows of one sample, (3,) or (6,): of the noise and what the reading states."""
    own = np.nan_to_num(np.r_[sample.sigma_position, sample.sigma_rotation])
    return np.hypot((noise.position, noise.rotation), own).repeat(3)[: 6 if sample.is_pose[0] else 3]

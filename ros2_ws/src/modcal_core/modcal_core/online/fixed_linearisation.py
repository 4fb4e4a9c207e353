"""A model held at one set of values, and what single samples say of it: the quick way to residual and derivatives.

:func:`~modcal_core.calibration.linearise` inserts the values again in every call, which pays for thousands of samples
at once. Here that is done once, and a sample costs one pass along the chain and a few small products.

What a place does to the tool is first seen at the root's origin, for there it goes along the chain like the frames do:
with the adjoint matrix of the place's frame, which for one joint more is multiplied by that of one joint. The way from
there to the tool is the same for all.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import asin, sqrt

import numpy as np

from modcal_core.calibration import (
    INSTRUMENT,
    Deviations,
    Model,
    ModelParameter,
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
_AT_ROOT = np.eye(7, 6)  # the frame of the first joint is the root


class FixedLinearisation:
    """Residual and derivatives of single samples at these values of a model's parameters and effects."""

    def __init__(self, start: Model, parameters: Sequence[ModelParameter], values: Array) -> None:
        """values: of the parameters, and behind them those of the effects; left out, effects stay as they are."""
        now = model_at(start, parameters, values)
        self._start, self._parameters, self._values = start, parameters, values
        errors = deviations(start, parameters, values[: len(parameters)])
        self._chain: Chain | None = None
        if not is_serial_arm(now.chain):  # of closed chains nothing can be carried from joint to joint
            self._model, self._effects = now, len(values) > len(parameters)
            return
        self._twists = [_twists(now, parameters, errors, frame) for frame in range(len(now.frames))]
        self._model = now
        self._effects = len(values) > len(parameters)
        chain = now.serial
        T_root_frame = se3.inverse(now.T_frame_base @ chain.T_base_root)
        self._R_root_frame, self._p_root_frame = list(T_root_frame[:, :3, :3]), list(T_root_frame[:, :3, 3])
        rooted = np.array(chain.origins)
        rooted[0] = se3.inverse(se3.transform(chain.joint_basis[0]))
        rooted[-1] = rooted[-1] @ now.T_tip_tool
        self._chain = chain.with_origins(rooted)
        self._steps = _steps(self._chain)

    def __call__(self, sample: Samples) -> tuple[Array, Array]:
        """(residual (3,) or (6,): position [m] then rotation [rad], its negative derivative (3 or 6, P)) of one row."""
        if self._chain is None:
            return self._of_closed(sample)
        if not self._model.effects:
            return self._of_geometry(sample)
        at = self._model.drivers(sample)
        twists, scale = motion(self._model.effects, at)
        f = frames(self._chain, sample.q, twists)
        T_root_place = np.concatenate([f.transform(k) for k in range(len(f.p))])
        residual, J, reading = self._seen(sample, sample.reading[0] / scale[0], _carried(T_root_place)[..., :6])
        if self._effects:
            position, rotation = residual[:3, None], residual[3:, None].reshape(3, -1)
            view = RowView(sample, np.flatnonzero(sample.is_pose), f, position, rotation, reading[:, None])
            more = [view.moved_by(terms) for terms in all_columns(self._model.effects, at)]
            J = np.concatenate([J, np.stack(more, axis=1)], axis=1)
        return residual, J

    def _of_closed(self, sample: Samples) -> tuple[Array, Array]:
        at = self._model.drivers(sample)
        view = RowView.of(self._model, sample, at)
        J = geometry_rows(view, self._start, self._parameters, self._values)
        if self._effects:
            J = np.concatenate([J, *(view.moved_by(terms)[None] for terms in all_columns(self._model.effects, at))])
        return np.concatenate([view.position.ravel(), view.rotation.ravel()]), J.T

    def _of_geometry(self, sample: Samples) -> tuple[Array, Array]:
        """The same for an arm without effects: for one posture, products of small matrices are the least work."""
        q = sample.q[0]
        parts = np.empty((len(q), 1, 4))
        parts[:, 0, 0], parts[:, 0, 3] = 1.0, q
        np.cos(q, out=parts[:, 0, 1])
        np.sin(q, out=parts[:, 0, 2])
        steps = (parts @ self._steps).reshape(-1, 7, 7)
        carried = np.empty((len(q) + 1, 7, 6))
        carried[0], carried[1] = _AT_ROOT, steps[0, :, :6]
        outer = carried[1]
        for step, inner in zip(steps[1:], carried[2:], strict=True):
            outer = np.dot(step, outer, out=inner)
        residual, J, _ = self._seen(sample, sample.reading[0], carried)
        return residual, J

    def _seen(self, sample: Samples, position: Array, carried: Array) -> tuple[Array, Array, Array]:
        """(residual, J of the geometry, what was read as seen from the root).

        position: what was read, (3,) [m]. carried: of every place as :func:`_carried` says, but for the last column,
        (n + 1, 7, 6).
        """
        # dot, for with matrices as small as these @ spends half as long again on its call
        frame, rows = int(sample.frame[0]), 6 if sample.is_pose[0] else 3
        R_root_frame = self._R_root_frame[frame]
        R_tool_root, p = carried[-1, :3, :3], carried[-1, 6, :3]
        reading = R_root_frame.dot(position)
        residual = reading + self._p_root_frame[frame] - p
        to_tool = _EYE.copy()
        to_tool[3:, :3] = p.dot(HAT).reshape(3, 3)
        J = self._twists[frame].dot(carried.reshape(-1, 6)).dot(to_tool[:, :rows])
        if rows == 6:
            residual = np.concatenate([residual, small_log(R_root_frame.dot(sample.R[0]).dot(R_tool_root))])
        return residual, J.T, reading


def _twists(now: Model, parameters: Sequence[ModelParameter], errors: Deviations, frame: int) -> Array:
    """The twist that each parameter makes per unit, in the frame of its place, (P, 7 (n + 1)); for readings in a frame.

    Behind each place's six directions stands a zero, for what moves with them in :func:`_carried`.
    """
    of_frames, of_places = local_twists(errors.frames), local_twists(errors.places)
    out = np.zeros((len(parameters), now.serial.n + 1, 7))
    with_it = (frame, now.leader(frame))
    for j, p in enumerate(parameters):
        if p.place == INSTRUMENT:
            continue  # of an instrument whose readings do not come here: nothing moves with it
        if p.place:
            out[j, p.place, :6] = of_places[p.place - 1][p.direction]
        elif p.frame in with_it:  # of a frame that does not lead this one, readings in this one say nothing
            out[j, 0, :6] = of_frames[p.frame][p.direction]
    return out.reshape(len(parameters), -1)


def _carried(T: Array) -> Array:
    """What goes from place to place along a chain, (..., 7, 7), of transforms (..., 4, 4).

    Rows 0 to 5: by the six directions of a twist in the inner frame, the twist in the outer one, which is the adjoint
    matrix transposed. Row 6: the position. The matrix of ``T_a_b T_b_c`` is that of ``T_b_c`` times that of ``T_a_b``.
    """
    out = np.zeros((*T.shape[:-2], 7, 7))
    out[..., :6, :6] = np.swapaxes(se3.adjoint(T), -1, -2)
    out[..., 6, :3] = T[..., :3, 3]
    out[..., 6, 6] = 1.0
    return out


def _steps(chain: Chain) -> Array:
    """From each place to the next, what is constant and what goes with cos q, sin q and q; flat, (n, 4, 49)."""
    motions = np.zeros((chain.n, 4, 7, 7))
    motions[:, 0] = np.eye(7)
    for terms, turns in zip(motions, chain.revolute, strict=True):
        if turns:  # Rz(q)
            for x, y in ((0, 1), (3, 4)):
                terms[0, x, x] = terms[0, y, y] = 0.0
                terms[1, x, x] = terms[1, y, y] = terms[2, x, y] = 1.0
                terms[2, y, x] = -1.0
        else:
            terms[3, 6, 2] = terms[3, 3, 1] = 1.0
            terms[3, 4, 0] = -1.0
    return np.asarray(_carried(chain.along_z[1:])[:, None] @ motions).reshape(chain.n, 4, 49)


def small_log(R: Array) -> Array:
    """Rotation vector (3,) [rad] of one rotation (3, 3), which is meant to be small: then without a quaternion."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    x, y, z = 0.5 * (h - f), 0.5 * (c - g), 0.5 * (d - b)
    sine = sqrt(x * x + y * y + z * z)
    if sine > 0.5 or a + e + i < 1.0:
        return so3.log(R)
    scale = asin(sine) / sine if sine > 1e-8 else 1.0
    return np.array([scale * x, scale * y, scale * z])

"""The same arm written with the least change to its drawing.

A turn about, or a shift along, a revolute joint's axis can stand before the joint or after it; nothing measures which.
The fit settles this by leaving directions out, which puts all of it wherever it left room. For a file that people read
and compare, the freedom is used instead to keep the constants of every joint as close to nominal as they can be, in
units of what a robot is usually wrong by. The motion of the tool is the same to rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import PRIOR_ANGLE_RAD, PRIOR_LENGTH_M
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.mechanism import Mechanism, is_serial_arm

_APART = 1e-3  # usual errors, between which derivatives are taken
_STILL = 1e-7  # usual errors; steps below say nothing
_MAX_STEPS = 20  # iterations


def least_change(model: Model, nominal: Mechanism) -> Model:
    """The model, predicting the same, whose chain differs least from the nominal one.

    Its first and last constants are the nominal ones: what they would hold belongs to the base frames and to the tool.
    """
    if not is_serial_arm(nominal):
        return model  # a Delta's constants leave no such freedom
    n = nominal.n
    A = se3.transform(nominal.joint_basis)
    inner = se3.inverse(A[:-1]) @ model.serial.origins[1:n] @ A[1:]
    drawn = se3.inverse(se3.inverse(A[:-1]) @ nominal.origins[1:n] @ A[1:])
    unit = np.array([PRIOR_LENGTH_M] * 3 + [PRIOR_ANGLE_RAD] * 3)

    def change(x: Array) -> Array:
        D = _passing(nominal, x)
        moved = se3.inverse(D[..., :-1, :, :]) @ inner @ D[..., 1:, :, :]
        return np.asarray((se3.log(drawn @ moved) / unit).reshape(*x.shape[:-1], -1))

    x = np.zeros(sum(_sizes(nominal)))
    if n > 1:  # of a single joint nothing lies between base and tool
        x = _least_squares(change, x)
    D = _passing(nominal, x)
    origins = np.array(model.serial.origins)
    for k in range(1, n):
        origins[k] = A[k - 1] @ se3.inverse(D[k - 1]) @ inner[k - 1] @ D[k] @ se3.inverse(A[k])
    origins[0], origins[n] = nominal.origins[0], nominal.origins[n]
    before = model.serial.origins[0] @ A[0] @ D[0] @ se3.inverse(nominal.origins[0] @ A[0])
    after = se3.inverse(nominal.origins[n]) @ A[-1] @ se3.inverse(D[-1]) @ se3.inverse(A[-1]) @ model.serial.origins[n]
    return replace(
        model,
        chain=model.serial.with_origins(origins),
        T_frame_base=model.T_frame_base @ before,
        T_tip_tool=after @ model.T_tip_tool,
    )


def passing_directions(chain: Chain, T_tip_tool: Array) -> Array:
    """Deviations at places 1 … n, six each, that together change nothing the tool does, (6 n, passing), to first order.

    One column for each direction that passes through a joint: it is taken from behind the joint, and what it was there
    stands before it; for the first joint that is the base, which has no row. Places are those of
    :mod:`modcal_core.calibration.parameters`.
    """
    n = chain.n
    M = chain.along_z
    out = np.zeros((6 * n, sum(_sizes(chain))))
    column = 0
    for k in range(n):
        behind = M[k + 1] @ T_tip_tool if k == n - 1 else M[k + 1]
        seen = se3.adjoint(se3.inverse(behind))
        for d in (2, 5) if chain.revolute[k] else (0, 1, 2, 5):
            out[6 * k : 6 * k + 6, column] = -seen[:, d]
            if k > 0:
                out[6 * (k - 1) + d, column] = 1.0
            column += 1
    return out


def _sizes(chain: Chain) -> list[int]:
    return [2 if turns else 4 for turns in chain.revolute]


def _least_squares(residual: Callable[[Array], Array], x: Array) -> Array:
    """Where the residuals (…, R) of x (…, P) are least, from here, by Newton's method without second derivatives.

    They are close to linear here, so that a few steps do.
    """
    r = residual(x)
    apart = _APART * np.eye(len(x))
    for _ in range(_MAX_STEPS):
        ends = residual(np.concatenate([x + apart, x - apart]))
        J = ((ends[: len(x)] - ends[len(x) :]) / (2.0 * _APART)).T
        step = -np.linalg.lstsq(J, r, rcond=1e-9)[0]  # nothing along what changes nothing
        if np.abs(step).max(initial=0.0) < _STILL:
            break
        for share in (1.0, 0.3, 0.1, 0.01):
            new = residual(x + share * step)
            if new @ new < r @ r:
                break
        else:
            break
        x, r = x + share * step, new
    return x


def _passing(chain: Chain, x: Array) -> Array:
    """Motions (…, n, 4, 4) that pass through each joint: shift and turn about z, and all shifts where it slides.

    x: (…, P), in units of what a robot is usually wrong by.
    """
    xi = np.zeros((*x.shape[:-1], chain.n, 6))
    for k, part in enumerate(np.split(x, np.cumsum(_sizes(chain))[:-1], axis=-1)):
        turn = 1 if chain.revolute[k] else 3
        shifts = (2,) if chain.revolute[k] else (0, 1, 2)
        xi[..., k, shifts], xi[..., k, 5] = part[..., :turn] * PRIOR_LENGTH_M, part[..., turn] * PRIOR_ANGLE_RAD
    return se3.exp(xi)

"""Motions by six values, shift and turn, of any size: ``Trans(t) Rot(exp ω)``, and their derivatives."""

from __future__ import annotations

import numpy as np

from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array

DIRECTIONS = ("x", "y", "z", "rx", "ry", "rz")  # of the six values of a twist


def error_transform(twist: Array) -> Array:
    """``Trans(t) Rot(exp ω)`` (..., 4, 4) of errors' six values (t, ω) (..., 6) [m, rad]."""
    return se3.transform(so3.exp(twist[..., 3:]), twist[..., :3])


def local_twists(twist: Array) -> Array:
    """The twists (..., 6, 6) that each of the six values makes per unit, in the frame after the error; one per row.

    ``E(x + dx) = E(x) exp(sum dx_d · row_d)``: a shift is seen from the turned frame, and a turn through the right
    Jacobian of the exponential.
    """
    out = np.zeros((*twist.shape, 6))
    # rows of the first are Rᵀ e_d; the second is the transpose of the right Jacobian
    out[..., :3, :3], out[..., 3:, 3:] = so3.exp_and_left_jacobian(twist[..., 3:])
    return out


def error_values(T: Array) -> Array:
    """The six values (t, ω) (..., 6) [m, rad] of transforms (..., 4, 4): the inverse of :func:`error_transform`."""
    return np.concatenate([T[..., :3, 3], so3.log(T[..., :3, :3])], axis=-1)

"""Rigid transforms as 4 × 4 matrices, twists ξ = (v, ω) with the linear part first, batched over leading axes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array


def transform(R: ArrayLike | None = None, p: ArrayLike | None = None) -> Array:
    """Transforms (..., 4, 4) of rotations (..., 3, 3) and positions (..., 3) [m]; either may be left out."""
    R = np.eye(3) if R is None else np.asarray(R, dtype=float)
    p = np.zeros(3) if p is None else np.asarray(p, dtype=float)
    alike = R.shape[:-2] == p.shape[:-1]
    T = np.zeros((R.shape[:-2] if alike else np.broadcast_shapes(R.shape[:-2], p.shape[:-1])) + (4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = p
    T[..., 3, 3] = 1.0
    return T


def inverse(T: ArrayLike) -> Array:
    """Inverse transforms (..., 4, 4): ``T_b_a`` of ``T_a_b``."""
    T = np.asarray(T, dtype=float)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    out = np.zeros(T.shape)
    out[..., :3, :3] = Rt
    np.negative(Rt @ T[..., :3, 3:], out=out[..., :3, 3:])
    out[..., 3, 3] = 1.0
    return out


def exp(xi: ArrayLike) -> Array:
    """Transforms (..., 4, 4) of twists (..., 6) [m, rad]."""
    xi = np.asarray(xi, dtype=float)
    R, V = so3.exp_and_left_jacobian(xi[..., 3:])
    return transform(R, (V @ xi[..., :3, None])[..., 0])


def log(T: ArrayLike) -> Array:
    """Twists (..., 6) [m, rad] of transforms (..., 4, 4), with rotation angle in [0, π]."""
    T = np.asarray(T, dtype=float)
    w = so3.log(T[..., :3, :3])
    v = so3.left_jacobian_inverse(w) @ T[..., :3, 3:]
    return np.concatenate([v[..., 0], w], axis=-1)


def adjoint(T: ArrayLike) -> Array:
    """Adjoint matrices (..., 6, 6): ``T_a_b exp(ξ_b) T_a_b⁻¹ = exp(Ad(T_a_b) ξ_b)``."""
    T = np.asarray(T, dtype=float)
    R = T[..., :3, :3]
    Ad = np.zeros(T.shape[:-2] + (6, 6))
    Ad[..., :3, :3] = R
    Ad[..., 3:, 3:] = R
    Ad[..., :3, 3:] = so3.hat(T[..., :3, 3]) @ R
    return Ad


def from_pose(pose: ArrayLike) -> Array:
    """Transforms (..., 4, 4) of poses x y z qx qy qz qw (..., 7) [m]."""
    pose = np.asarray(pose, dtype=float)
    return transform(so3.from_quaternion(pose[..., 3:]), pose[..., :3])


def to_pose(T: ArrayLike) -> Array:
    """Poses x y z qx qy qz qw (..., 7) [m] of transforms (..., 4, 4), with qw ≥ 0."""
    T = np.asarray(T, dtype=float)
    q = so3.to_quaternion(T[..., :3, :3])
    return np.concatenate([T[..., :3, 3], np.where(q[..., 3:] < 0.0, -q, q)], axis=-1)


def apply(T: ArrayLike, p: ArrayLike) -> Array:
    """Points (..., 3) in a, of points (..., 3) in b and ``T_a_b`` (..., 4, 4)."""
    T, p = np.asarray(T, dtype=float), np.asarray(p, dtype=float)
    return (T[..., :3, :3] @ p[..., None])[..., 0] + T[..., :3, 3]


def error(T: ArrayLike, goal: ArrayLike) -> Array:
    """What is missing from poses (..., 4, 4) to others, seen from the first, (..., 6): way [m], rotation vector [rad].

    Of many; :func:`modcal_core.geometry.single.pose_error` is of one.
    """
    T, goal = np.asarray(T, dtype=float), np.asarray(goal, dtype=float)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    way = (Rt @ (goal[..., :3, 3] - T[..., :3, 3])[..., None])[..., 0]
    return np.concatenate([way, so3.log(Rt @ goal[..., :3, :3])], axis=-1)

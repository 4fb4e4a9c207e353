"""Poses one at a time, where a control loop cannot wait for what is made for many."""

from __future__ import annotations

import math

import numpy as np

from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array


def posed(R: Array, p: Array) -> Array:
    """The pose (4, 4) of a rotation (3, 3) and a position (3,)."""
    out = np.zeros((4, 4))
    out[:3, :3], out[:3, 3], out[3, 3] = R, p, 1.0
    return out


def turned(w: Array) -> Array:
    """Rotation matrix (3, 3) of one rotation vector (3,) [rad]."""
    angle = math.sqrt(w @ w)
    a, b = (math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle**2) if angle > 1e-6 else (1.0, 0.5)
    x, y, z = w.tolist()
    # I + a W + b W² written out: as matrices it takes three times as long
    p, q, r = a * x, a * y, a * z
    xy, xz, yz = b * x * y, b * x * z, b * y * z
    xx, yy, zz = b * x * x, b * y * y, b * z * z
    return np.array([[1.0 - yy - zz, xy - r, xz + q], [xy + r, 1.0 - xx - zz, yz - p], [xz - q, yz + p, 1.0 - xx - yy]])


def tool_from(T: Array, x: Array) -> Array:
    """The pose (4, 4) that lies x = (way, rotation vector) (6,) from T (4, 4), seen from T; undoes ``pose_error``."""
    return posed(T[:3, :3] @ turned(x[3:]), T[:3, 3] + T[:3, :3] @ x[:3])


def along_screw(T: Array, xi: Array) -> Array:
    """The pose exp(ξ) T (4, 4) for one space twist ξ = (v, ω) (6,) [m, rad]."""
    v, w = xi[:3], xi[3:]
    angle = math.sqrt(w @ w)
    if angle < 1e-9:
        return posed(T[:3, :3], T[:3, 3] + v)
    R = turned(w)
    n = w / angle
    # V v of the exponential, split into what lies along the axis and what turns about it (Lynch and Park, 3.3)
    u = v / angle
    c = crossed(u, n)
    shift = R @ c - c + n * (n @ v)
    return posed(R @ T[:3, :3], R @ T[:3, 3] + shift)


def relative(T: Array, seen_from: Array, v: Array) -> Array:
    """A vector (3,) given in the axes of ``seen_from`` (4, 4), in those of T (4, 4)."""
    return T[:3, :3].T @ (seen_from[:3, :3] @ v)


def speeds(before: Array, after: Array) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses (4, 4)."""
    d = after[:3, 3] - before[:3, 3]
    # |R − R'|² = 8 sin²(½ angle), which keeps small angles
    e = (after[:3, :3] - before[:3, :3]).ravel()
    return math.sqrt(d @ d), 2.0 * math.asin(min(1.0, math.sqrt(e @ e / 8.0)))


def crossed(a: Array, b: Array) -> Array:
    """Cross product (3,) of two vectors; np.cross takes longer to begin than this to finish."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def crossed_rows(a: Array, b: Array) -> Array:
    """Cross products of rows (..., 3); np.cross takes longer to begin than this to finish."""
    out = np.empty(np.broadcast(a, b).shape)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., i] = a[..., j] * b[..., k] - a[..., k] * b[..., j]
    return out


def rotation_vector(R: Array) -> Array:
    """Rotation vector (3,) of one rotation matrix; so3.log is for many, and exact near half a turn."""
    v = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine, cosine = math.sqrt(v @ v), 0.5 * (float(R[0, 0] + R[1, 1] + R[2, 2]) - 1.0)
    if cosine < -0.9:
        return so3.log(R)
    return v * (math.atan2(sine, cosine) / sine) if sine > 1e-9 else v


def pose_error(T: Array, goal: Array) -> Array:
    """What is missing from a pose (4, 4) to another, seen from the first, (6,): way [m], then rotation vector [rad]."""
    R = T[:3, :3]
    out = np.empty(6)
    out[:3] = R.T @ (goal[:3, 3] - T[:3, 3])
    out[3:] = rotation_vector(R.T @ goal[:3, :3])
    return out

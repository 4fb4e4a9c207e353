"""Kinematics of one posture at a time, without what a batch costs: for what runs in a loop with a clock."""

from __future__ import annotations

import math

import numpy as np

from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain


def posture_frames(chain: Chain, q: Array) -> tuple[Array, Array]:
    """Frames before each joint, its axis as z, (n, 4, 4), and the tip (4, 4), in the base; q: (n,) [rad, m]."""
    M = chain.along_z
    motion = np.zeros((chain.n, 4, 4))
    angle = q * chain.revolute
    motion[:, 0, 0] = motion[:, 1, 1] = np.cos(angle)
    motion[:, 1, 0] = np.sin(angle)
    motion[:, 0, 1] = -motion[:, 1, 0]
    motion[:, 2, 2] = motion[:, 3, 3] = 1.0
    motion[:, 2, 3] = q - angle
    links = motion @ M[1:]
    out = np.empty((chain.n, 4, 4))
    T = M[0]
    for k in range(chain.n):
        out[k] = T
        T = T @ links[k]
    return out, T


def joint_motions(chain: Chain, before: Array, tip: Array) -> tuple[Array, Array]:
    """Velocities (n, 3) and turns (n, 3) of the tip per unit of each joint, seen from the tip: its body Jacobian.

    before, tip: as :func:`posture_frames` gives them.
    """
    R, p = tip[:3, :3], tip[:3, 3]
    axis, arm = before[:, :3, 2], p - before[:, :3, 3]
    v, w = cross(axis, arm), axis
    if not chain.revolute.all():
        turn = chain.revolute[:, None]
        v, w = np.where(turn, v, axis), np.where(turn, axis, 0.0)
    return v @ R, w @ R


def pose_and_jacobian(chain: Chain, q: Array) -> tuple[Array, Array]:
    """The tip in the base (4, 4) and its body Jacobian (6, n), for joints q (n,) [rad, m]."""
    before, tip = posture_frames(chain, q)
    v, w = joint_motions(chain, before, tip)
    return tip, np.concatenate([v, w], axis=1).T


def pose_error(T: Array, goal: Array) -> Array:
    """What is missing from a pose (4, 4) to another, seen from the first, (6,): way [m], then rotation vector [rad]."""
    R = T[:3, :3]
    out = np.empty(6)
    out[:3] = R.T @ (goal[:3, 3] - T[:3, 3])
    out[3:] = rotation_vector(R.T @ goal[:3, :3])
    return out


def rotation_vector(R: Array) -> Array:
    """Rotation vector (3,) of one rotation matrix; so3.log is for many, and exact near half a turn."""
    v = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine, cosine = math.sqrt(v @ v), 0.5 * (float(R[0, 0] + R[1, 1] + R[2, 2]) - 1.0)
    if cosine < -0.9:
        return so3.log(R)
    return v * (math.atan2(sine, cosine) / sine) if sine > 1e-9 else v


def cross(a: Array, b: Array) -> Array:
    """Cross products of rows (n, 3); np.cross takes longer to begin than this to finish."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[:, 0] = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    out[:, 1] = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    out[:, 2] = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return out

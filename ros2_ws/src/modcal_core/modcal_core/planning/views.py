"""Postures that show the target: where random ones hardly ever do, as with a camera that looks at a board.

The line of sight is drawn first, in both cones and within range, then a turn about it; the arm is brought there by
inverse kinematics. So these are spread evenly over what can be seen, and not over the joints' ranges.
"""

from __future__ import annotations

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.planning.site import Cone, Site
from modcal_core.robots.chain import Chain
from modcal_core.robots.inverse_batch import inverse_batch
from modcal_core.robots.mechanism import random_postures

_AROUND = Cone(np.array([0.0, 0.0, 1.0]), np.pi)  # every direction


def view_postures(chain: Chain, site: Site, count: int, rng: np.random.Generator) -> Array:
    """Postures (m, n) within the joints' limits at which the site's instrument looks at the target.

    count: lines of sight that are tried; those that the arm does not reach are left out. What stands in between, and
    what the arm must not touch, is not asked here.
    """
    tracker, target = site.tracker, site.target
    assert tracker is not None
    start = random_postures(chain, count, rng)
    reach = _reach(chain)
    farthest = min(tracker.farthest, tracker.nearest + 2.0 * reach)
    distance = rng.uniform(max(tracker.nearest, target.radius), farthest, count)
    view = tracker.view or _AROUND
    # so much of the view is taken up by the target itself
    room = view.half_angle - np.arcsin(np.minimum(target.radius / np.maximum(distance, 1e-9), 1.0))
    seen = room > 0.0
    start, distance, room = start[seen], distance[seen], room[seen]
    to_target = _within(view.axis, room, rng)
    facing = target.facing or _AROUND
    to_eye = _within(facing.axis, np.full(len(distance), facing.half_angle), rng)
    T = np.tile(np.eye(4), (len(distance), 1, 1))
    if tracker.carried:
        R = _turned(to_target, -to_eye, rng)
        T[:, :3, 3] = target.position + distance[:, None] * to_eye - R @ tracker.position
    else:
        R = _turned(to_eye, -to_target, rng)
        T[:, :3, 3] = tracker.position + distance[:, None] * to_target - R @ target.position
    T[:, :3, :3] = R
    near = np.linalg.norm(T[:, :3, 3], axis=1) <= reach
    reached = inverse_batch(chain, T[near], start[near])
    return np.asarray(reached.q[reached.met])


def _reach(chain: Chain) -> float:
    """Length [m] of the arm stretched out."""
    M = chain.along_z
    return float(np.linalg.norm(M[:, :3, 3], axis=1).sum())


def _within(axis: Array, angle: Array, rng: np.random.Generator) -> Array:
    """Unit directions (N, 3), evenly over caps of these angles (N,) [rad] about an axis (3,)."""
    up = rng.uniform(np.cos(angle), 1.0)
    turn = rng.uniform(0.0, 2.0 * np.pi, len(angle))
    beside = np.sqrt(np.maximum(1.0 - up**2, 0.0))
    local = np.stack([beside * np.cos(turn), beside * np.sin(turn), up], axis=1)
    return np.asarray(local @ _basis(axis[None])[0].T)


def _turned(a: Array, b: Array, rng: np.random.Generator) -> Array:
    """Rotations (N, 3, 3) that take directions a (N, 3) to b (N, 3), turned about b at random."""
    angle = rng.uniform(0.0, 2.0 * np.pi, len(a))
    roll = np.tile(np.eye(3), (len(a), 1, 1))
    roll[:, 0, 0] = roll[:, 1, 1] = np.cos(angle)
    roll[:, 1, 0], roll[:, 0, 1] = np.sin(angle), -np.sin(angle)
    return np.asarray(_basis(b) @ roll @ _basis(a).transpose(0, 2, 1))


def _basis(z: Array) -> Array:
    """Rotations (N, 3, 3) whose last columns are these unit directions (N, 3)."""
    helper = np.where(np.abs(z[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(helper, z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=2)

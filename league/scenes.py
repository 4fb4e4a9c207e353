"""Scenes whose truth is known and that need no tracker: a ball in sockets, a camera and a board, doors and drawers.

What is wrong with them is written in other terms than any method here fits: a lens that bends by the division model on
a sensor that is not square to it, doors that sag, hands that give a little and turn on the handle. The file is frozen
as ``generator.py`` is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from league.arm import Array, pose, quaternion, rotation
from league.generator import World

PAIRS, SEATS, APART = 4, 18, 0.05  # placements of a plate, postures a socket, distance of its two sockets [m]
SEATING, PLATE = 3e-5, 2e-5  # m: where a ball comes to rest, and how far a plate is off
TILT = np.radians(60.0)  # that a socket allows, and at which a board is still seen
COLUMNS, ROWS, SQUARE = 8, 6, 0.03  # of a board
SIZE = np.array([1280, 960])  # px of an image


def tips(world: World, q: Array) -> Array:
    """Poses (N, 4, 4) of the target where nothing but geometry is wrong."""
    return world.poses(q, q, np.zeros(len(q)))


def sockets(world: World) -> tuple[Array, Array, Array]:
    """(Joints (M, n) with the ball at rest, the socket of each (M,), neighbours in number; pairs (P, 2))."""
    rng, parts, frames = world.rng, [], []
    for pair in range(PAIRS):
        first = tips(world, world.postures(1))[0]
        across = rng.normal(size=3)
        across -= across @ first[:3, 2] * first[:3, 2]
        gap = (APART + PLATE * rng.normal()) * across / np.linalg.norm(across)
        for k in range(2):
            q, goal = world.postures(14 * SEATS, 0.9), first[:3, 3] + k * gap
            goals = goal + SEATING * rng.normal(size=(len(q), 3))
            q = _reached(world, q, goals)
            T = tips(world, q)
            good = np.linalg.norm(T[:, :3, 3] - goals, axis=1) < 1e-7
            good &= T[:, :3, 2] @ first[:3, 2] > np.cos(TILT)
            good &= ((q > np.maximum(world.arm.low, -np.pi)) & (q < np.minimum(world.arm.high, np.pi))).all(axis=1)
            parts.append(q[good][:SEATS])
            frames.append(np.full(len(parts[-1]), 2 * pair + k))
    return np.concatenate(parts), np.concatenate(frames), np.arange(2 * PAIRS).reshape(-1, 2)


def _reached(world: World, q: Array, goals: Array) -> Array:
    """Joints (N, n) near q with the ball at the goals (N, 3) [m], where damped Gauss–Newton steps lead there."""
    R, p = world.tracker[:3, :3], world.tracker[:3, 3]
    for _ in range(25):
        at = (tips(world, q)[:, :3, 3] - p) @ R  # in the base, as the nominal arm's axes are
        frames = world.arm.frames(q)[:, :-1]
        J = np.swapaxes(np.cross(frames[..., :3, 2], at[:, None] - frames[..., :3, 3]), 1, 2)
        step = np.linalg.solve(J @ np.swapaxes(J, 1, 2) + 1e-8 * np.eye(3), ((goals - p) @ R - at)[..., None])
        q = q + np.clip((np.swapaxes(J, 1, 2) @ step)[..., 0], -0.3, 0.3)
    return q


def board() -> Array:
    """Inner corners (C, 3) [m] of the board as it is sold: x right, y down, z into it."""
    row, column = np.divmod(np.arange((COLUMNS - 1) * (ROWS - 1)), COLUMNS - 1)
    return SQUARE * np.stack([column + 1.0, row + 1.0, np.zeros(len(row))], axis=1)


@dataclass(frozen=True)
class Lens:
    """focal, centre (2,) [px]; bend: of the division model; lean (2,): of the sensor [rad]."""

    focal: Array
    centre: Array
    bend: float
    lean: Array

    def pixels(self, X: Array) -> Array:
        """Where points (…, 3) before the camera are seen (…, 2) [px]."""
        x = X[..., :2] / X[..., 2:]
        x = 2.0 * x / (1.0 + np.sqrt(1.0 - 4.0 * self.bend * np.sum(x**2, axis=-1, keepdims=True)))
        return self.focal * x / (1.0 + np.sum(self.lean * x, axis=-1, keepdims=True)) + self.centre


def camera(world: World, on_tip: bool) -> Lens:
    """A camera, with board and camera put where they see each other from the middle of the arm's ranges.

    ``world.poses`` are then those of the camera in the board's frame, or of the board in the camera's.
    """
    rng, middle = world.rng, 0.5 * (world.arm.low + world.arm.high)
    tip = world.arm.frames(middle[None])[0, -1]
    centre = 0.5 * SQUARE * np.array([COLUMNS, ROWS, 0.0])
    away = rotation(0.15 * rng.normal(size=3)) @ rotation(np.array([0.0, 0.0, rng.uniform(-0.4, 0.4)]))
    seen = pose(away, np.array([0.0, 0.0, 0.5 if on_tip else 0.7]) - away @ centre)  # of the board by the camera
    back = rotation(np.array([np.pi, 0.0, 0.0]))
    own = rotation(0.1 * rng.normal(size=3))
    if on_tip:
        world.tool = pose(own, np.array([0.06, 0.0, 0.05]) + 0.01 * rng.normal(size=3))
        world.tracker = np.linalg.inv(tip @ world.tool @ seen)
    else:
        world.tool = pose(own @ back, np.array([0.0, 0.0, 0.05]) - own @ back @ centre)
        world.tracker = seen @ np.linalg.inv(tip @ world.tool)
    focal = rng.uniform(950.0, 1150.0) * np.array([1.0, 1.0 + 1e-3 * rng.normal()])
    return Lens(focal, 0.5 * SIZE + 15.0 * rng.normal(size=2), rng.uniform(-0.14, -0.06), 3e-3 * rng.normal(size=2))


def views(world: World, lens: Lens, on_tip: bool, count: int) -> tuple[Array, Array, Array]:
    """(Joints (count, n) at which most of the board is seen, ``world.poses`` there, corners (count, C, 2) [px], NaN
    where they are not in the image).
    """
    rng, arm, points = world.rng, world.arm, board() * (1.0 + 2e-4 * world.rng.normal())
    middle, half = 0.5 * (arm.low + arm.high), np.minimum(0.45 * (arm.high - arm.low), 0.7)
    q = rng.uniform(middle - half, middle + half, (60 * count, len(middle)))
    T = tips(world, q)
    by_camera = np.linalg.inv(T) if on_tip else T
    X = np.einsum("nij,cj->nci", by_camera[:, :3, :3], points) + by_camera[:, None, :3, 3]
    ahead = X[..., 2] > 0.15
    pixels = lens.pixels(np.where(ahead[..., None], X, [0.0, 0.0, 1.0]))
    inside = ahead & ((pixels > 8.0) & (pixels < SIZE - 8.0)).all(axis=2)
    line = by_camera[:, :3, 3] / np.linalg.norm(by_camera[:, :3, 3], axis=1, keepdims=True)
    rows = np.flatnonzero((inside.mean(axis=1) > 0.7) & (np.sum(line * by_camera[:, :3, 2], axis=1) > np.cos(TILT)))
    rows = rows[:count]
    shake = 0.05 * rng.normal(size=(len(rows), 1, 2))  # px, of an image as a whole
    noise = rng.normal(size=pixels[rows].shape) * np.where(
        rng.uniform(size=(len(rows), len(points), 1)) < 0.01, 2, 0.12
    )
    return q[rows], T[rows], np.where(inside[rows, :, None], pixels[rows] + shake + noise, np.nan)


@dataclass(frozen=True)
class Pull:
    """kind: revolute or prismatic. true: poses (n, 4, 4) of the handle. seen: the same as they are read."""

    kind: str
    true: Array
    seen: Array


def pull(rng: np.random.Generator) -> Pull:
    """A door or a drawer that somebody opens."""
    n, slides = int(rng.integers(80, 300)), rng.uniform() < 0.4
    way = np.linspace(0.0, 1.0, n) ** rng.uniform(0.8, 1.4)
    bump = np.sin(np.pi * way) * rng.normal() + np.sin(2.0 * np.pi * way) * rng.normal()
    T = np.tile(np.eye(4), (n, 1, 1))
    if slides:
        T[:, 0, 3] = rng.uniform(0.2, 0.5) * way
        T[:, 1, 3] = 7e-4 * bump  # rails have play
        T[:, :3, :3] = rotation(3e-3 * bump[:, None] * np.array([0.0, 0.0, 1.0]))
    else:
        radius, angle = rng.uniform(0.25, 0.9), np.radians(rng.uniform(35.0, 95.0)) * way
        T[:, 0, 3], T[:, 1, 3] = radius * np.cos(angle), radius * np.sin(angle)
        T[:, 2, 3] = -rng.uniform(0.0, 2e-3) * way + 4e-4 * bump  # it sags
        T[:, :3, :3] = rotation(angle[:, None] * np.array([0.0, 0.0, 1.0]))
    T = pose(rotation(rng.normal(size=3)), rng.normal(size=3)) @ T @ pose(rotation(rng.normal(size=3)), np.zeros(3))
    noise, turns, give = rng.uniform(5e-4, 3e-3), np.radians(rng.uniform(0.3, 2.0)), rng.uniform(2e-4, 1.5e-3)
    loose = rng.uniform() < 0.25  # the hand turns on the handle
    drift = _slow(rng, n) * give
    p = T[:, :3, 3] + drift + noise * rng.standard_t(5, size=(n, 3))
    wrong = rng.uniform(size=n) < 0.02
    p[wrong] += 0.1 * rng.normal(size=(wrong.sum(), 3))
    slip = _slow(rng, n) * (0.15 if loose else 5e-3)
    return Pull(
        "prismatic" if slides else "revolute",
        T,
        pose(T[:, :3, :3] @ rotation(slip + turns * rng.normal(size=p.shape)), p),
    )


def _slow(rng: np.random.Generator, n: int) -> Array:
    """Three errors (n, 3) of size one that change slowly."""
    knots = rng.normal(size=(8, 3))
    at = np.linspace(0.0, 7.0, n)
    return np.stack([np.interp(at, np.arange(8.0), knots[:, k]) for k in range(3)], axis=1)


def read(T: Array) -> Array:
    """Poses (N, 4, 4) as x y z and a quaternion (N, 7)."""
    return np.concatenate([T[:, :3, 3], quaternion(T[:, :3, :3])], axis=1)

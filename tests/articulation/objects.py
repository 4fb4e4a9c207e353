"""Doors, drawers and screws as a truth of their own: plain trigonometry, no code of the room under test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Seen:
    """A track and its truth: positions (n, 3), rotations (n, 3, 3), kind, configurations, axis, a point on it, pitch."""

    positions: Array
    rotations: Array
    kind: str
    a: Array
    axis: Array
    point: Array
    pitch: float


def ideal(kind: str, a: Array, rng: np.random.Generator, radius: float = 0.4, pitch: float = 0.0) -> Seen:
    """The track of a handle without any flaw, somewhere in a room. pitch: [m/rad], of a screw only."""
    pitch = pitch if kind == "screw" else 0.0
    world = Rotation.random(random_state=int(rng.integers(2**31)))
    place = rng.uniform(-1.0, 1.0, 3)
    hold = Rotation.random(random_state=int(rng.integers(2**31)))
    zero = np.zeros_like(a)
    if kind == "prismatic":
        local, turns = np.stack([a, zero, zero], axis=1), Rotation.from_rotvec(np.zeros((len(a), 3)))
    elif kind == "rigid":
        local, turns = np.zeros((len(a), 3)), Rotation.from_rotvec(np.zeros((len(a), 3)))
    else:
        local = np.stack([radius * np.cos(a), radius * np.sin(a), pitch * a], axis=1)
        turns = Rotation.from_rotvec(np.stack([zero, zero, a], axis=1))
    axis = world.as_matrix() @ ([1.0, 0.0, 0.0] if kind == "prismatic" else [0.0, 0.0, 1.0])
    rotations = (world * turns * hold).as_matrix()
    return Seen(world.apply(local) + place, rotations, kind, a, axis, place, pitch)


def noisy(seen: Seen, rng: np.random.Generator, position: float, rotation: float = 0.0) -> Seen:
    """The same with white noise [m, rad] on every axis."""
    n = len(seen.a)
    jitter = Rotation.from_rotvec(rng.normal(0.0, 1.0, (n, 3)) * rotation).as_matrix()
    p = seen.positions + rng.normal(0.0, 1.0, (n, 3)) * position
    return Seen(p, seen.rotations @ jitter, seen.kind, seen.a, seen.axis, seen.point, seen.pitch)


def _waves(path: Array, size: float, rng: np.random.Generator) -> Array:
    """A smooth departure (n, 3) along the path, of about this size: three waves of 15 cm to 1.5 m."""
    out = np.zeros((len(path), 3))
    for _ in range(3):
        length = np.exp(rng.uniform(np.log(0.15), np.log(1.5)))
        phase = rng.uniform(0.0, 2.0 * np.pi, 3)
        out += rng.normal(0.0, size * np.sqrt(2.0 / 3.0), 3) * np.sin(2.0 * np.pi * path[:, None] / length + phase)
    return out


def real(kind: str, rng: np.random.Generator, reach: float = 1.0) -> Seen:
    """A track as people record it: uneven speed, a dwell, smooth departures, jitter, and a few gross outliers.

    reach: share of the full opening that is seen.
    """
    n = int(rng.integers(60, 400))
    s = np.sort(rng.beta(0.8, 0.8, n))
    if rng.random() < 0.4:
        s = np.concatenate([s, s[::-1]])[:: 2 if n > 200 else 1]  # opened and closed again
    radius = rng.uniform(0.2, 0.9)
    pitch = 0.0
    if kind == "prismatic":
        a = s * rng.uniform(0.25, 0.5) * reach
        path = a
    else:
        if kind == "screw":
            radius, pitch = rng.uniform(0.1, 0.3), rng.choice([-1.0, 1.0]) * rng.uniform(0.03, 0.1)
        a = s * np.radians(rng.uniform(50.0, 110.0)) * reach * (1.5 if kind == "screw" else 1.0)
        path = a * radius
    seen = ideal(kind, a, rng, radius, pitch)
    n = len(a)
    p = seen.positions + _waves(path, np.exp(rng.uniform(np.log(3e-4), np.log(3e-3))), rng)
    p = p + rng.normal(0.0, np.exp(rng.uniform(np.log(2e-4), np.log(2e-3))), (n, 3))
    sway = _waves(path, np.radians(np.exp(rng.uniform(np.log(0.3), np.log(3.0)))), rng)
    sway += rng.normal(0.0, np.radians(np.exp(rng.uniform(np.log(0.2), np.log(2.0)))), (n, 3))
    gross = rng.random(n) < rng.uniform(0.0, 0.05)
    p[gross] += rng.normal(0.0, 0.1, (int(gross.sum()), 3))
    sway[gross] += rng.normal(0.0, 0.5, (int(gross.sum()), 3))
    R = seen.rotations @ Rotation.from_rotvec(sway).as_matrix()
    return Seen(p, R, kind, a, seen.axis, seen.point, pitch)

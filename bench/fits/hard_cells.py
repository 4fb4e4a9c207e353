"""Cells whose geometry is hard to find: tools and sockets that the drawing's arm puts in the wrong place.

What no model can predict of a recording is known exactly: the difference to MuJoCo.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.append(str(Path(__file__).resolve().parents[1]))
from arms import SHIFT, TWIST, Arm
from sites import BEGIN, PERIOD, Array, joint_track, reading, rms, unit

from modcal_core.measurements.recording import POINT, Recording

Rng = np.random.Generator
MIDDLE = np.array([0.3, -1.2, 1.5, -1.3, -1.4, 0.2])  # rad; of the UR10 in front of it, away from singular postures
DISTANCE = 0.05  # m between the two sockets of a plate


@dataclass(frozen=True)
class Fitted:
    """A recording, what is known of its cell, and the RMS [mm] that no model of the arm can go below.

    exact: the same without noise. tool: the point of the tip that is seen (3,) [m]. distances: pairs of sockets that
    are DISTANCE apart.
    """

    urdf: str
    tip: str
    recording: Recording
    exact: Recording
    floor_mm: float
    tool: Array
    distances: tuple[tuple[str, str], ...] = ()


def cube(rng: Rng, side: float = 0.3, tilt: float = 0.5, length: float = 0.055, error: float = 1.0) -> Fitted:
    """A grid of 6³ places in a cube of this side [m], points alone; a controller that knows the drawing of the UR10
    goes there, the tool tilted by about ``tilt`` [rad].

    length: of the tool [m]. error: displacement of every body, in units of 0.5 mm and 1 mrad.
    """
    arm, drawn, tool = (
        Arm.of("ur10", rng, error * SHIFT, error * TWIST),
        Arm.of("ur10"),
        length * unit(rng.normal(size=3)),
    )
    while True:
        q0 = MIDDLE + rng.normal(0, 0.15, arm.n)
        middle, R0 = drawn.tool(q0[None], tool)
        axis = (np.arange(6) / 5 - 0.5) * side
        places = middle + np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
        corners = places[[0, 5, 30, -1, 180]]
        if not drawn.reaching(np.tile(q0, (5, 1)), tool, corners, np.repeat(R0, 5, axis=0))[1].all():
            continue
        turns = Rotation.from_rotvec(rng.normal(0, tilt / np.sqrt(3.0), places.shape)) * Rotation.from_matrix(R0[0])
        q, found = drawn.reaching(np.tile(q0, (len(places), 1)), tool, places, turns.as_matrix())
        if found.mean() >= 0.9:
            break
    q = q[found]
    exact, seen = (arm.tool(at, tool)[0] for at in (q, q + rng.normal(0, 2e-5, q.shape)))
    eye, stand = Rotation.random(rng=rng), rng.uniform(-3.0, 3.0, 3)
    p, true = eye.apply(seen - stand) + rng.normal(0, 3e-5, seen.shape), eye.apply(exact - stand)
    every = np.ones(len(q), bool)
    read, without = (_recording(arm, q, [("tracker", every, points)]) for points in (p, true))
    return Fitted(arm.urdf, arm.tip, read, without, 1e3 * rms(p - true), tool)


def sockets(
    rng: Rng, placements: int = 5, each: int = 30, length: float = 0.1, error: float = 4.0, repeat: float = 1e-4
) -> Fitted:
    """A ball on a Panda held in two sockets of a plate that is put down in several places; joints alone are recorded.

    length: of the ball's stem beyond the tip [m]. error: as of :func:`cube`. repeat: of each joint [rad].
    """
    arm, tool = Arm.of("panda", rng, error * SHIFT, error * TWIST), length * unit(rng.normal(size=3))
    noted, held, missed, names = [], [], [], []
    for k in range(placements):
        pair: list[Array | None] = [None]
        while any(rows is None for rows in pair):
            middle = rng.uniform(*(arm.range.mean(axis=0) + 0.6 * (arm.range - arm.range.mean(axis=0))))
            first = arm.tool(middle[None], tool)[0][0]
            ends = first, first + DISTANCE * unit(rng.normal(size=3))
            pair = [_holding(arm, tool, end, middle, each, rng) for end in ends]
        for i, rows in enumerate(pair):
            names.append(f"place{k}_hole{i}")
            held.append(rows)
            noted.append(rows + rng.normal(0, repeat, rows.shape))
            missed.append(arm.tool(noted[-1], tool)[0] - ends[i])
    which = np.repeat(np.arange(len(names)), each)
    readings = [(name, which == i, np.zeros((each, 3))) for i, name in enumerate(names)]
    pairs = tuple(zip(names[::2], names[1::2], strict=True))
    read, without = (_recording(arm, np.concatenate(q), readings) for q in (noted, held))
    return Fitted(arm.urdf, arm.tip, read, without, 1e3 * rms(np.concatenate(missed)), tool, pairs)


def _holding(arm: Arm, tool: Array, point: Array, q: Array, each: int, rng: Rng) -> Array | None:
    """Postures (each, n) that hold the ball at a point, turned by some half a radian about it."""
    out: list[Array] = []
    for _ in range(4 * each):
        near, found = arm.reaching(q[None] + rng.normal(0, 0.4, arm.n), tool, point[None])
        out += [near[0]] * bool(found[0])
        if len(out) == each:
            return np.array(out)
    return None


def _recording(arm: Arm, q: Array, readings: list[tuple[str, Array, Array]]) -> Recording:
    t = BEGIN + PERIOD * np.arange(len(q))
    tracks = tuple(reading(t[rows], p, POINT, name) for name, rows, p in readings)
    return Recording((joint_track(arm.names, t, q),), tracks, (), arm.urdf)


KINDS: dict[str, Callable[[Rng], Fitted]] = {
    "cube_one_orientation": lambda rng: cube(rng, tilt=0.0, side=0.4, error=6.0),
    "cube_hardly_tilted": lambda rng: cube(rng, tilt=5e-4, side=0.4, error=6.0),
    "cube_little_tilted": lambda rng: cube(rng, tilt=2e-3, side=0.4, error=10.0),
    "cube_far_tool": lambda rng: cube(rng, tilt=1e-3, side=0.3, length=0.4, error=6.0),
    "sockets_4": lambda rng: sockets(rng, placements=4, error=12.0),
    "sockets_6": lambda rng: sockets(rng, placements=6, error=12.0),
    "sockets_4_longer": lambda rng: sockets(rng, placements=4, each=60, error=12.0),
    "sockets_6_longer": lambda rng: sockets(rng, placements=6, each=60, error=12.0),
    "sockets_6_scattering": lambda rng: sockets(rng, placements=6, length=0.2, error=6.0, repeat=3e-4),
}

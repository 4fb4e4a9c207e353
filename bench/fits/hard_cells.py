"""Cells whose geometry is hard to find: tools and sockets that the drawing's arm puts in the wrong place.

The arm is that of bench/undeclared: MuJoCo's kinematics of a URDF whose every body is displaced. From modcal only the
writing of recordings is used. What no model can predict of a recording is known exactly: the difference to MuJoCo.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.append(str(Path(__file__).resolve().parents[1] / "undeclared"))
import arm as displaced
from arm import Arm

from modcal_core.measurements.recording import POINT, JointTrack, ReadingTrack, Recording

Array = np.ndarray
BEGIN, PERIOD = 1.7e9, 4.0  # s
MIDDLE = {"ur10": (0.3, -1.2, 1.5, -1.3, -1.4, 0.2)}  # rad; in front of the arm, away from singular postures
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


def arm_of(robot: str, rng: np.random.Generator, shift: float, twist: float) -> Arm:
    """An arm whose bodies are off by so much, per axis [m, rad]."""
    before = displaced.SHIFT, displaced.TWIST
    displaced.SHIFT, displaced.TWIST = shift, twist
    try:
        return Arm(robot, rng)
    finally:
        displaced.SHIFT, displaced.TWIST = before


def tool_at(arm: Arm, q: Array, tool: Array) -> tuple[Array, Rotation]:
    """Where a point of the tip is, (N, 3) [m], and how the tip is turned."""
    p, R = arm.frames(arm.coordinates(np.atleast_2d(q)))
    tip = Rotation.from_matrix(R[:, -1])
    return p[:, -1] + tip.apply(tool), tip


def reached(arm: Arm, tool: Array, point: Array, turned: Rotation | None, q: Array) -> Array | None:
    """Joint positions (n,) near q that hold the tool's point where it is asked for, and turned so, if that is asked."""
    apart = 1e-6 * np.eye(arm.n)
    for _ in range(15):
        p, R = tool_at(arm, np.concatenate([q[None], q + apart]), tool)
        gap, rows = point - p[0], (p[1:] - p[0]).T / 1e-6
        if turned is not None:
            gap = np.concatenate([gap, (turned * R[0].inv()).as_rotvec()])
            rows = np.concatenate([rows, (R[1:] * R[0].inv()).as_rotvec().T / 1e-6])
        if np.abs(gap).max() < 1e-9:
            return q
        step = rows.T @ np.linalg.solve(rows @ rows.T + 1e-8 * np.eye(len(rows)), gap)
        q = q + step * min(1.0, 0.3 / max(float(np.abs(step).max()), 1e-12))
    return None


def cube(
    rng: np.random.Generator,
    robot: str = "ur10",
    side: float = 0.3,
    tilt: float = 0.5,
    length: float = 0.055,
    error: float = 1.0,
    count: int = 6,
    noise_mm: float = 0.03,
    repeat: float = 2e-5,
) -> Fitted:
    """A grid of count³ places in a cube of this side [m], points alone; a controller that knows the drawing goes there,
    the tool tilted by about ``tilt`` [rad].

    length: of the tool [m]. error: displacement of every body, in units of 0.5 mm and 1 mrad.
    """
    arm, drawn = arm_of(robot, rng, error * 5e-4, error * 1e-3), Arm(robot)
    way = rng.normal(size=3)
    tool = length * way / np.linalg.norm(way)
    while True:
        q0 = np.array(MIDDLE[robot]) + rng.normal(0, 0.15, arm.n)
        middle, R0 = tool_at(drawn, q0, tool)
        axis = (np.arange(count) / (count - 1) - 0.5) * side
        places = middle[0] + np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
        corners = [0, count - 1, count * (count - 1), len(places) - 1, count**2 * (count - 1)]
        if any(reached(drawn, tool, places[k], R0[0], q0) is None for k in corners):
            continue
        turns = [Rotation.from_rotvec(rng.normal(0, tilt / np.sqrt(3.0), 3)) * R0[0] for _ in places]
        near = [reached(drawn, tool, place, turn, q0) for place, turn in zip(places, turns, strict=True)]
        found = [q for q in near if q is not None]
        if len(found) >= 0.9 * len(places):
            break
    q = np.array(found)
    exact, _ = tool_at(arm, q, tool)
    seen, _ = tool_at(arm, q + rng.normal(0, repeat, q.shape), tool)
    eye, stand = Rotation.random(rng=rng), rng.uniform(-3.0, 3.0, 3)
    noise = rng.normal(0, 1e-3 * noise_mm, seen.shape)
    p, true = eye.apply(seen - stand) + noise, eye.apply(exact - stand)
    floor = float(np.sqrt(np.mean(np.sum((p - true) ** 2, axis=1))))
    t, every = BEGIN + PERIOD * np.arange(len(q)), np.ones(len(q), bool)
    read, without = (_recording(arm, t, q, [("tracker", every, points)]) for points in (p, true))
    return Fitted(arm.urdf, arm.tip, read, without, 1e3 * floor, tool)


def sockets(
    rng: np.random.Generator,
    robot: str = "panda",
    placements: int = 5,
    each: int = 30,
    length: float = 0.1,
    error: float = 4.0,
    repeat: float = 1e-4,
) -> Fitted:
    """A ball held in two sockets of a plate, which is put down in several places; joints alone are recorded.

    length: of the ball's stem beyond the tip [m]. error: as of :func:`cube`. repeat: of each joint [rad].
    """
    arm = arm_of(robot, rng, error * 5e-4, error * 1e-3)
    way = rng.normal(size=3)
    tool = length * way / np.linalg.norm(way)
    q, held, parts, names, missed = [], [], [], [], []
    for k in range(placements):
        pair = None
        while pair is None:
            middle = rng.uniform(*(arm.range.mean(axis=0) + 0.6 * (arm.range - arm.range.mean(axis=0))))
            first, _ = tool_at(arm, middle, tool)
            along = rng.normal(size=3)
            ends = first[0], first[0] + DISTANCE * along / np.linalg.norm(along)
            pair = [_holding(arm, tool, end, middle, each, rng) for end in ends]
            pair = None if any(rows is None for rows in pair) else pair
        for i, rows in enumerate(pair):
            name = f"place{k}_hole{i}"
            names.append(name)
            noted = rows + rng.normal(0, repeat, rows.shape)
            p, _ = tool_at(arm, noted, tool)
            missed.append(np.sum((p - ends[i]) ** 2, axis=1))
            parts.append((name, len(rows)))
            q.append(noted)
            held.append(rows)
    which = np.repeat(np.arange(len(parts)), [n for _, n in parts])
    Q = np.concatenate(q)
    t = BEGIN + PERIOD * np.arange(len(Q))
    readings = [(name, which == i, np.zeros((n, 3))) for i, (name, n) in enumerate(parts)]
    floor = 1e3 * float(np.sqrt(np.mean(np.concatenate(missed))))
    pairs = tuple((names[2 * k], names[2 * k + 1]) for k in range(placements))
    read, without = (_recording(arm, t, joints, readings) for joints in (Q, np.concatenate(held)))
    return Fitted(arm.urdf, arm.tip, read, without, floor, tool, pairs)


def _holding(arm: Arm, tool: Array, point: Array, q: Array, each: int, rng: np.random.Generator) -> Array | None:
    """Postures (each, n) that hold the ball at a point, turned by some half a radian about it."""
    out: list[Array] = []
    for _ in range(4 * each):
        near = reached(arm, tool, point, None, q + rng.normal(0, 0.4, arm.n))
        if near is not None:
            out.append(near)
        if len(out) == each:
            return np.array(out)
    return None


def _recording(arm: Arm, t: Array, q: Array, readings: list[tuple[str, Array, Array]]) -> Recording:
    unknown = np.full_like(q, np.nan)
    tracks = tuple(ReadingTrack(POINT, name, t[rows], p, t[rows]) for name, rows, p in readings)
    return Recording((JointTrack(arm.names, t, q, unknown, unknown, t),), tracks, (), arm.urdf)


Maker = Callable[[np.random.Generator], Fitted]
KINDS: dict[str, Maker] = {
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

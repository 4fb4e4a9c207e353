"""Cells whose truth is MuJoCo's: a recording to calibrate from, and small ones after something has changed.

Arms, faults and poses come from ``bench/undeclared``. Nothing of what is planted is computed by modcal.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "undeclared"))

from arm import TURN, Arm, Array
from fault import Deviation, Draw, Fault, Stations
from recordings import Cell
from scenarios import compliance, gear_harmonic

STATIONS = 160
NOISE_MM, NOISE_MRAD, REPEATABILITY = 0.02, 0.02, 1e-5  # per axis; per joint [rad]
CAMERA_MM, CAMERA_MRAD = 0.3, 0.5  # per axis, of the board's pose as a camera on the hand sees it
TIMES = 3.0  # a planted change moves the tool by so many floors, RMS


@dataclass(frozen=True)
class Readings:
    """Joint positions (m, n), what the instrument said: positions (m, 3) [m], rotations; the exact positions."""

    q: Array
    p: Array
    R: Rotation
    exact_p: Array
    exact_R: Rotation


@dataclass(frozen=True)
class Change:
    """Something that happened after the calibration. names: (kind, place) that name it rightly. noise: factor."""

    names: tuple[tuple[str, str], ...]
    fault: Fault | None = None
    noise: float = 1.0


@dataclass
class Workplace:
    """One arm with its instrument. camera: it is a camera on the hand that sees a board (poses of the board)."""

    cell: Cell
    old: tuple[Fault, ...]
    camera: bool = False
    points: bool = False
    floor_mm: float = field(init=False, default=0.0)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(0)
        seen = self.measure(rng.uniform(*self.cell.arm.range, (200, self.cell.arm.n)), rng, ())
        self.floor_mm = 1e3 * float(np.sqrt(np.mean(np.sum((seen.p - seen.exact_p) ** 2, axis=1))))

    @property
    def noise(self) -> tuple[float, float]:
        """Of the instrument, per axis [m, rad]."""
        return (1e-3 * CAMERA_MM, 1e-3 * CAMERA_MRAD) if self.camera else (1e-3 * NOISE_MM, 1e-3 * NOISE_MRAD)

    def measure(self, q: Array, rng: np.random.Generator, changes: tuple[Change, ...]) -> Readings:
        """What the instrument says at these postures (m, n). Of a camera, the tool's pose in the board's frame."""
        faults = (*self.old, *(c.fault for c in changes if c.fault is not None))
        noise_m, noise_rad = (s * float(np.prod([c.noise for c in changes])) for s in self.noise)
        way = rng.choice([-1.0, 1.0], q.shape)
        t = np.arange(len(q)) * 2.0
        exact = self.cell.poses(Stations(q, t, way), faults)
        seen = self.cell.poses(Stations(q + rng.normal(0, REPEATABILITY, q.shape), t, way), faults)
        p = seen.p + rng.normal(0, noise_m, (len(q), 3))
        R = seen.R * Rotation.from_rotvec(rng.normal(0, noise_rad, (len(q), 3)))
        return Readings(q, p, R, exact.p, exact.R)


def workplace(
    robot: str, seed: int, camera: bool = False, points: bool = False
) -> tuple[Workplace, np.random.Generator]:
    """An arm that is displaced and, two times in three, has a gear's or a spring's error from the beginning."""
    rng = np.random.default_rng([seed, 26, camera, points])
    cell = Cell(robot, rng)
    q = rng.uniform(*cell.arm.range, (STATIONS, cell.arm.n))
    draw = Draw(rng, cell.arm, q, 300.0)
    old = ((), (gear_harmonic(draw),), (compliance(draw),))[seed % 3]
    return Workplace(cell, old, camera, points), rng


def _twist(place: str, rng: np.random.Generator) -> Callable[[float], Fault]:
    shift, turn = rng.normal(size=3), rng.normal(size=3)
    twist = np.r_[shift / np.linalg.norm(shift), 2.0 * turn / np.linalg.norm(turn)] * rng.uniform(0.3, 1.0, 6)

    def of(size: float) -> Fault:
        def bend(arm: Arm, stations: Stations, deviation: Deviation) -> None:
            (deviation.tool if place == "tool" else deviation.tracker)[:] += size * twist

        return Fault((), (place,), (), f"{1e3 * size:.3f}", bend)

    return of


def _zero(joint: int) -> Callable[[float], Fault]:
    def of(size: float) -> Fault:
        def bend(arm: Arm, stations: Stations, deviation: Deviation) -> None:
            deviation.x[:, joint, TURN] += size

        return Fault((), (), (), f"{1e3 * size:.3f} mrad", bend)

    return of


def _gear(joint: int, rng: np.random.Generator) -> Callable[[float], Fault]:
    ratio, phase, second = int(rng.integers(50, 162)), rng.uniform(0, 2 * np.pi, 2), rng.uniform(0, 0.5)
    if rng.random() < 0.3:  # an eccentric gear or encoder rather than a wave
        ratio = 1

    def of(size: float) -> Fault:
        def bend(arm: Arm, stations: Stations, deviation: Deviation) -> None:
            q = stations.q[:, joint]
            deviation.x[:, joint, TURN] += size * (
                np.sin(ratio * q + phase[0]) + second * np.sin(2 * ratio * q + phase[1])
            )

        return Fault((), (), (), f"{1e3 * size:.3f} mrad, {ratio} a turn", bend)

    return of


def _grown(old: Fault) -> Callable[[float], Fault]:
    """The curve that the arm had from the beginning, grown by a share."""

    def of(size: float) -> Fault:
        def bend(arm: Arm, stations: Stations, deviation: Deviation) -> None:
            before = deviation.x.copy()
            plain = Deviation(arm, stations)
            old.bend(arm, stations, plain)
            deviation.x[:] = before + size * (plain.x - arm.coordinates(stations.q))

        return Fault((), (), (), f"{size:+.0%}", bend)

    return of


def _scale(size: float) -> Fault:
    def bend(arm: Arm, stations: Stations, deviation: Deviation) -> None:
        deviation.scale *= 1.0 + size

    return Fault((), (), (), f"{1e6 * size:.0f} ppm", bend)


KINDS = ("base", "tool", "joint_zero", "gear", "tracker_scale", "tracker_noise")


def planted(place: Workplace, kind: str, q: Array, rng: np.random.Generator, times: float = TIMES) -> Change:
    """A change of one kind that moves the tool by so many floors, RMS, at these postures."""
    arm = place.cell.arm
    names = arm.names
    if kind == "tracker_noise":
        return Change((("tracker_noise", "tracker"),), noise=times)
    joint = int(rng.integers(arm.n))
    right: tuple[tuple[str, str], ...]
    if kind in ("base", "tool", "camera"):  # a camera on the hand is the tool
        where = "tool" if kind == "camera" else kind
        right, make = ((where, where),), _twist(where, rng)
    elif kind == "joint_zero":
        right, make = (("joint_zero", names[joint]),), _zero(joint)
    elif kind == "gear":
        own = [f for f in place.old if f.family == ("gear_harmonic",)]
        if own and rng.random() < 0.5:
            right, make = (("gear", own[0].place[0]),), _grown(own[0])
        else:
            right, make = (("gear", names[joint]),), _gear(joint, rng)
    else:
        right, make = (("tracker_scale", "tracker"),), _scale
    stations = Stations(q, np.arange(len(q)) * 2.0, np.ones_like(q))
    size = 1e-3
    for _ in range(4):  # what is planted moves the tool in proportion to its size, nearly
        moved = place.cell.size(stations, (make(size),), place.old).mm
        size *= times * place.floor_mm / moved
    return Change(right, make(size * rng.choice([-1.0, 1.0])))

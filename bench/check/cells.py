"""Cells whose truth is MuJoCo's: a recording to calibrate from, and small ones after something has changed.

Arms, faults and poses come from ``bench/undeclared``. Nothing of what is planted is computed by modcal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import harness
import numpy as np
from arm import TURN, Arm, Array
from fault import Deviation, Draw, Fault, Stations
from recordings import NOISE_MM, NOISE_MRAD, REPEATABILITY, Cell
from scenarios import compliance, gear_harmonic
from scipy.spatial.transform import Rotation

import modcal_core as modcal

STATIONS = 160
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


def distance(a: Array, b: Array) -> float:
    """RMS distance [mm] of points (m, 3) [m]."""
    return 1e3 * harness.rms(np.linalg.norm(a - b, axis=1))


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
        seen = self.measure(self.postures(rng, 200), rng, ())
        self.floor_mm = distance(seen.p, seen.exact_p)

    def postures(self, rng: np.random.Generator, count: int = STATIONS) -> Array:
        """Random ones (count, n)."""
        return rng.uniform(*self.cell.arm.range, (count, self.cell.arm.n))

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


def samples_of(place: Workplace, seen: Readings, begin: float) -> modcal.Samples:
    """What a user would hand over: points of a tracker, poses, or poses of the board that a camera on the hand sees."""
    names, stamps = place.cell.arm.names, begin + 2.0 * np.arange(len(seen.q))
    if place.points:
        return modcal.Samples.from_arrays(seen.q, points=seen.p, names=names, stamps=stamps)
    T = np.tile(np.eye(4), (len(seen.q), 1, 1))
    T[:, :3, 3], T[:, :3, :3] = seen.p, seen.R.as_matrix()
    return modcal.Samples.from_arrays(seen.q, poses=T, names=names, stamps=stamps)


def calibrated(
    place: Workplace, q: Array, rng: np.random.Generator, changes: tuple[Change, ...], begin: float = 1.7e9
) -> modcal.Result:
    """The result of calibrating from these postures."""
    robot = modcal.Robot.from_urdf(place.cell.arm.urdf, tip=place.cell.arm.tip)
    return modcal.calibrate(robot, samples_of(place, place.measure(q, rng, changes), begin), seed=0)


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


def _bends(places: tuple[str, ...], bend: Callable[[Deviation, Stations, float], None]) -> Callable[[float], Fault]:
    """A fault of any size."""

    def of(size: float) -> Fault:
        return Fault((), places, (), f"{size:.3g}", lambda arm, stations, deviation: bend(deviation, stations, size))

    return of


def _twist(place: str, rng: np.random.Generator) -> Callable[[float], Fault]:
    shift, turn = rng.normal(size=3), rng.normal(size=3)
    twist = np.r_[shift / np.linalg.norm(shift), 2.0 * turn / np.linalg.norm(turn)] * rng.uniform(0.3, 1.0, 6)

    def bend(deviation: Deviation, stations: Stations, size: float) -> None:
        (deviation.tool if place == "tool" else deviation.tracker)[:] += size * twist

    return _bends((place,), bend)


def at_joint(joint: int, error: Callable[[Array], Array | float]) -> Callable[[float], Fault]:
    """A joint that is off by a multiple of a function of its position."""

    def bend(deviation: Deviation, stations: Stations, size: float) -> None:
        deviation.x[:, joint, TURN] += size * error(stations.q[:, joint])

    return _bends((), bend)


def _gear(joint: int, rng: np.random.Generator) -> Callable[[float], Fault]:
    ratio, phase, second = int(rng.integers(50, 162)), rng.uniform(0, 2 * np.pi, 2), rng.uniform(0, 0.5)
    if rng.random() < 0.3:  # an eccentric gear or encoder rather than a wave
        ratio = 1
    return at_joint(joint, lambda q: np.sin(ratio * q + phase[0]) + second * np.sin(2 * ratio * q + phase[1]))


def _grown(old: Fault, arm: Arm) -> Callable[[float], Fault]:
    """The curve that the arm had from the beginning, grown by a share."""

    def bend(deviation: Deviation, stations: Stations, size: float) -> None:
        plain = Deviation(arm, stations)
        old.bend(arm, stations, plain)
        deviation.x += size * (plain.x - arm.coordinates(stations.q))

    return _bends((), bend)


def _scale(deviation: Deviation, stations: Stations, size: float) -> None:
    deviation.scale *= 1.0 + size


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
        right, make = (("joint_zero", names[joint]),), at_joint(joint, lambda q: 1.0)
    elif kind == "gear":
        own = [f for f in place.old if f.family == ("gear_harmonic",)]
        if own and rng.random() < 0.5:
            right, make = (("gear", own[0].place[0]),), _grown(own[0], arm)
        else:
            right, make = (("gear", names[joint]),), _gear(joint, rng)
    else:
        right, make = (("tracker_scale", "tracker"),), _bends((), _scale)
    stations = Stations(q, np.arange(len(q)) * 2.0, np.ones_like(q))
    size = 1e-3
    for _ in range(4):  # what is planted moves the tool in proportion to its size, nearly
        moved = place.cell.size(stations, (make(size),), place.old).mm
        size *= times * place.floor_mm / moved
    return Change(right, make(size * rng.choice([-1.0, 1.0])))

"""An arm of MuJoCo and an instrument that reads its stations one by one: where benches check and measure.

Arms, displacements and faults are those of the benches' own simulator: another engine, bodies displaced in all
directions, effects that are not written as modcal writes them. Nothing of what is planted is computed by modcal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import harness
import numpy as np
from scenarios import Draw, compliance, gear_harmonic
from scipy.spatial.transform import Rotation
from sites import (
    BEGIN,
    NOISE_MM,
    NOISE_MRAD,
    REPEAT,
    Bend,
    Cell,
    Deviation,
    Stations,
    turn_noise,
    turned,
    twisted,
    unit,
)

import modcal_core as modcal
from modcal_core.geometry import se3

Array = np.ndarray
EACH = 2.0  # s from one station to the next
STATIONS, TIMES = 160, 3.0  # of a calibration; a planted change moves the tool by so many floors, RMS
CAMERA = 3e-4, 5e-4  # per axis [m, rad], of the board's pose as a camera on the hand sees it
TRACKER = 1e-3 * NOISE_MM, 1e-3 * NOISE_MRAD
KINDS = ("base", "tool", "joint_zero", "gear", "tracker_scale", "tracker_noise")


def distance(a: Array, b: Array) -> float:
    """RMS distance [mm] of points (m, 3) [m]."""
    return 1e3 * harness.rms(np.linalg.norm(a - b, axis=1))


@dataclass(frozen=True)
class Readings:
    """Joint positions (m, n); positions (m, 3) [m] and rotations that the instrument said; the exact ones."""

    q: Array
    p: Array
    R: Rotation
    exact: Array
    exact_R: Rotation

    def samples(self, names: tuple[str, ...], points: bool = False, begin: float = BEGIN) -> modcal.Samples:
        """What a user would hand over: points of a tracker, poses, or the tool in the frame of a camera's board."""
        stamps = begin + EACH * np.arange(len(self.q))
        if points:
            return modcal.Samples.from_arrays(self.q, points=self.p, names=names, stamps=stamps)
        poses = se3.transform(self.R.as_matrix(), self.p)
        return modcal.Samples.from_arrays(self.q, poses=poses, names=names, stamps=stamps)


@dataclass
class Workplace:
    """One arm with its faults and its instrument; noise: per axis [m, rad]; repeats: per joint [rad]. gear: the joint
    whose gear has an error from the beginning.
    """

    cell: Cell
    faults: tuple[Bend, ...]
    noise: tuple[float, float] = TRACKER
    repeats: float = REPEAT
    gear: str | None = None

    def postures(self, rng: np.random.Generator, count: int = STATIONS) -> Array:
        return rng.uniform(*self.cell.arm.range, (count, self.cell.arm.n))

    def read(self, stations: Stations, rng: np.random.Generator, pose: bool = True) -> Readings:
        """What the instrument says at stations: of a pose, or of a point."""
        seen = self.cell.poses(self.reached(stations, rng), self.faults)
        p = seen.p + rng.normal(0.0, self.noise[0], seen.p.shape)
        R = seen.R * turn_noise(rng, self.noise[1], len(p)) if pose else seen.R
        exact = self.cell.poses(stations, self.faults)
        return Readings(stations.q, p, R, exact.p, exact.R)

    def reached(self, stations: Stations, rng: np.random.Generator) -> Stations:
        return replace(stations, q=stations.q + rng.normal(0.0, self.repeats, stations.q.shape))

    def measure(self, q: Array, rng: np.random.Generator) -> Readings:
        """Readings at postures (m, n), each joint from either side."""
        way = rng.choice([-1.0, 1.0], q.shape)
        return self.read(Stations(q, np.arange(len(q)) * EACH, way), rng)

    def floor_mm(self) -> float:
        rng = np.random.default_rng(0)
        seen = self.measure(self.postures(rng, 200), rng)
        return distance(seen.p, seen.exact)

    def after(self, fault: Bend | None, noise: float = 1.0) -> Workplace:
        """The same with another fault, and with another noise of the instrument."""
        faults = self.faults if fault is None else (*self.faults, fault)
        return replace(self, faults=faults, noise=(noise * self.noise[0], noise * self.noise[1]))

    def calibrated(self, seen: Readings, points: bool = False, begin: float = BEGIN) -> modcal.Result:
        arm = self.cell.arm
        robot = modcal.Robot.from_urdf(arm.urdf, tip=arm.tip)
        return modcal.calibrate(robot, seen.samples(arm.names, points, begin), seed=0)


def drawn(robot: str, seed: int, setup: str = "") -> tuple[Workplace, np.random.Generator]:
    """An arm that is displaced and, two times in three, has a gear's or a spring's error from the beginning."""
    camera = setup == "camera"
    rng = np.random.default_rng([seed, 26, camera, setup == "points"])
    cell = Cell(robot, rng)
    draw = Draw(rng, cell.arm, rng.uniform(*cell.arm.range, (STATIONS, cell.arm.n)), 300.0)
    gear, spring = gear_harmonic(draw), compliance(draw)
    faults = ((), (gear.bend,), (spring.bend,))[seed % 3]
    noise = CAMERA if camera else TRACKER
    return Workplace(cell, faults, noise, gear=gear.place[0] if seed % 3 == 1 else None), rng


def at_joint(joint: int, error: Callable[[Array], Array | float]) -> Callable[[float], Bend]:
    """A joint that is off by a multiple of a function of its position."""
    return lambda size: turned(joint, lambda s: size * error(s.q[:, joint]))


def _moved(part: str, rng: np.random.Generator) -> Callable[[float], Bend]:
    shift, turn = rng.normal(size=3), rng.normal(size=3)
    twist = np.r_[unit(shift), 2.0 * unit(turn)] * rng.uniform(0.3, 1.0, 6)
    return lambda size: twisted(part, size * twist, lambda s: np.ones(len(s.t)))


def _gear(joint: int, rng: np.random.Generator) -> Callable[[float], Bend]:
    ratio, phase, second = int(rng.integers(50, 162)), rng.uniform(0, 2 * np.pi, 2), rng.uniform(0, 0.5)
    if rng.random() < 0.3:  # an eccentric gear or encoder rather than a wave
        ratio = 1
    return at_joint(joint, lambda q: np.sin(ratio * q + phase[0]) + second * np.sin(2 * ratio * q + phase[1]))


def _grown(place: Workplace, size: float) -> Bend:
    """The curve that the arm had from the beginning, grown by a share."""

    def bend(s: Stations, d: Deviation) -> None:
        plain = Deviation(place.cell.arm, s)
        place.faults[0](s, plain)
        d.x += size * (plain.x - place.cell.arm.coordinates(s.q))

    return bend


def _scaled(size: float) -> Bend:
    def bend(s: Stations, d: Deviation) -> None:
        d.scale *= 1.0 + size

    return bend


def planted(place: Workplace, kind: str, q: Array, rng: np.random.Generator) -> tuple[tuple[str, str], Workplace]:
    """A change of one kind that moves the tool by three floors, RMS, at these postures: (kind, place) that name it
    rightly, and the workplace after it.
    """
    if kind == "tracker_noise":
        return (kind, "tracker"), place.after(None, TIMES)
    joint = int(rng.integers(place.cell.arm.n))
    right, make = (kind, place.cell.arm.names[joint]), at_joint(joint, lambda q: 1.0)
    if kind in ("base", "tool", "camera"):  # a camera on the hand is the tool
        right = ("base", "base") if kind == "base" else ("tool", "tool")
        make = _moved("tracker" if kind == "base" else "tool", rng)
    elif kind == "tracker_scale":
        right, make = (kind, "tracker"), _scaled
    elif kind == "gear" and place.gear is not None and rng.random() < 0.5:
        right, make = (kind, place.gear), lambda size: _grown(place, size)
    elif kind == "gear":
        make = _gear(joint, rng)
    stations, size, floor = Stations(q, np.arange(len(q)) * EACH, np.ones_like(q)), 1e-3, place.floor_mm()
    still = place.cell.poses(stations, place.faults).p
    for _ in range(4):  # what is planted moves the tool in proportion to its size, nearly
        size *= TIMES * floor / distance(place.cell.poses(stations, (*place.faults, make(size))).p, still)
    return right, place.after(make(size * rng.choice([-1.0, 1.0])))

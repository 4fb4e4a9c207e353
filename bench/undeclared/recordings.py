"""A cell with a displaced arm, a tracker and planted faults: two recordings of it, and the truth about them."""

from __future__ import annotations

import json
import zlib
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from arm import Arm, Array
from fault import Deviation, Draw, Fault, Stations
from scenarios import MOVING, SCENARIOS, Maker
from scipy.spatial.transform import Rotation

from modcal_core.measurements.recording import POSE, JointTrack, ReadingTrack, Recording, SignalTrack
from modcal_msgs_py.recording_write import write_recording

BEGIN = 1.7e9  # s
STATIONS, STATIONS_SECOND = 160, 60
PAUSE = 120.0  # s between the two recordings
RATE, MOVE, DWELL = 25.0, 1.2, 0.6  # Hz, s, s
COURSE, COURSE_SECOND, JOINT_RATE, TRACKER_RATE, SPEED = 60.0, 40.0, 125.0, 50.0, 0.3  # s, s, Hz, Hz, m/s
NOISE_MM, NOISE_MRAD, REPEATABILITY = 0.02, 0.02, 1e-5  # per axis; per joint [rad]
EFFORT_NOISE = 0.05  # N m
MIN = 2.5  # a planted fault stands out of the noise by this factor (RMS) after the best geometry


@dataclass(frozen=True)
class Poses:
    """Tool poses (m,) in the tracker's frame [m]."""

    p: Array
    R: Rotation


@dataclass(frozen=True)
class Size:
    """How much a fault moves the tool: RMS of the difference, and what of it no displacement of any body takes up."""

    mm: float
    mrad: float
    visible_mm: float
    visible_mrad: float

    @property
    def over_noise(self) -> float:
        per_axis = np.hypot(self.visible_mm / NOISE_MM, self.visible_mrad / NOISE_MRAD)
        return float(per_axis / np.sqrt(6.0))


class Cell:
    """An arm, its tool and the tracker beside it."""

    def __init__(self, robot: str, rng: np.random.Generator) -> None:
        self.arm = Arm(robot, rng)
        way = rng.normal(size=3)
        self.tool = rng.uniform(0.05, 0.15) * way / np.linalg.norm(way), Rotation.random(rng=rng)
        azimuth, distance = rng.uniform(0, 2 * np.pi), rng.uniform(2.0, 4.0)
        self.tracker = (
            np.array([distance * np.cos(azimuth), distance * np.sin(azimuth), rng.uniform(0.3, 1.5)]),
            Rotation.random(rng=rng),
        )

    def poses(self, stations: Stations, faults: tuple[Fault, ...]) -> Poses:
        """Where the tool is at stations, as a tracker without noise sees it."""
        deviation = Deviation(self.arm, stations)
        for fault in faults:
            fault.bend(self.arm, stations, deviation)
        self.arm.carry(deviation.payload)
        x = self.arm.settle(deviation.x, deviation.linear, deviation.cubic)
        p, R = self.arm.frames(x)
        tip = Rotation.from_matrix(R[:, -1])
        tool = tip * self.tool[1]
        bumped = tool * Rotation.from_rotvec(deviation.tool[:, 3:])
        at = p[:, -1] + tip.apply(self.tool[0]) + tool.apply(deviation.tool[:, :3])
        stand = self.tracker[0] + deviation.tracker[:, :3]
        eye = (Rotation.from_rotvec(deviation.tracker[:, 3:]) * self.tracker[1]).inv()
        return Poses(deviation.scale * eye.apply(at - stand), eye * bumped)

    def size(self, stations: Stations, faults: tuple[Fault, ...], others: tuple[Fault, ...] = ()) -> Size:
        """How much faults move the tool, beside others."""
        with_, without = self.poses(stations, (*others, *faults)), self.poses(stations, others)
        return self.size_of(stations, with_, without)

    def size_of(self, stations: Stations, with_: Poses, without: Poses) -> Size:
        """The size of the difference of poses, before and after displacing every body has taken up its part."""
        p, R = self.arm.frames(self.arm.coordinates(stations.q))
        at = (p[:, -1] + np.einsum("mij,j->mi", R[:, -1], self.tool[0]))[:, None]
        p = np.concatenate([np.zeros_like(p[:, :1]), p], axis=1)  # the base is a body as well
        R = np.concatenate([np.broadcast_to(np.eye(3), R[:, :1].shape), R], axis=1)
        turned = np.cross(R, (at - p)[..., None], axisa=-2, axisb=-2, axisc=-2)  # columns: axis × lever
        zero = np.zeros_like(R)
        eye = self.tracker[1].inv().as_matrix()
        columns = np.concatenate(
            [np.concatenate([eye @ R, eye @ turned], -1), np.concatenate([zero, eye @ R], -1)], axis=-2
        )
        m = len(stations.t)
        A = np.moveaxis(columns, 1, 2).reshape(6 * m, -1)
        raw = np.concatenate([with_.p - without.p, (with_.R * without.R.inv()).as_rotvec()], axis=1)
        rest = raw.ravel() - A @ np.linalg.lstsq(A, raw.ravel(), rcond=1e-10)[0]
        halves = [v[:, s] for v in (raw, rest.reshape(m, 6)) for s in (slice(3), slice(3, 6))]
        return Size(*(1e3 * float(np.sqrt(np.mean(np.sum(v**2, axis=1)))) for v in halves))


@dataclass(frozen=True)
class Plan:
    """What the arm is told to do: stamps since the session's beginning [s], and motion (m, n) of the joint states.

    stations: what the tracker is asked for, and when; ends: the rows of the joint states that belong to them.
    """

    t: Array
    q: Array
    v: Array
    a: Array
    stations: Stations
    ends: Array | None


def point_to_point(arm: Arm, rng: np.random.Generator, count: int, begin: float) -> Plan:
    """Random postures, with smooth moves between them and a short stand at each."""
    q = rng.uniform(*arm.range, (count + 1, arm.n))
    t, rows, now, ends = [], [], begin, []
    for a, b in pairwise(q):
        move = MOVE * rng.uniform(0.9, 1.1)
        s = np.arange(0.0, move + DWELL + 0.5 / RATE, 1.0 / RATE)
        u = np.clip(s / move, 0.0, 1.0)[:, None]
        rows.append(
            np.stack(
                [
                    a + (b - a) * (10 * u**3 - 15 * u**4 + 6 * u**5),
                    (b - a) * 30 * u**2 * (1 - u) ** 2 / move,
                    (b - a) * 60 * u * (1 - u) * (1 - 2 * u) / move**2,
                ]
            )
        )
        t.append(now + s)
        now += s[-1] + 1.0 / RATE
        ends.append(len(s))
    motion, last = np.concatenate(rows, axis=1), np.cumsum(ends) - 1
    stamps = np.round(np.concatenate(t), 6)
    way = np.sign(np.diff(q, axis=0))
    return Plan(stamps, *motion, stations=Stations(q[1:], stamps[last], way), ends=last)


def course(cell: Cell, rng: np.random.Generator, duration: float, begin: float) -> Plan:
    """A smooth course of several sines a joint, at a speed of the tool that is usual for a tracker."""
    arm = cell.arm
    f, phase = rng.uniform(0.03, 0.2, (3, arm.n)), rng.uniform(0, 2 * np.pi, (3, arm.n))
    share = rng.dirichlet(np.full(3, 4.0), arm.n).T * 0.5 * np.ptp(arm.range, axis=0)

    def motion(t: Array, pace: float) -> Array:
        w = 2 * np.pi * f * pace
        angle = t[:, None, None] * w + phase
        return np.stack(
            [
                arm.range.mean(axis=0) + (share * np.sin(angle)).sum(axis=1),
                (share * w * np.cos(angle)).sum(axis=1),
                -(share * w**2 * np.sin(angle)).sum(axis=1),
            ]
        )

    s = np.arange(0.0, duration, 1.0 / TRACKER_RATE)
    pace = 1.0
    for _ in range(5):
        q = motion(s, pace)[0]
        p = cell.poses(Stations(q, s, np.zeros_like(q)), ()).p
        pace *= SPEED / np.sqrt(np.mean(np.sum(np.diff(p, axis=0) ** 2, axis=1))) / TRACKER_RATE
    fine = np.arange(0.0, duration, 1.0 / JOINT_RATE)
    # the tracker runs on its own beat, and while joint states are there
    s = s[(s > 0.1) & (s < duration - 0.1)] + 0.37 / TRACKER_RATE
    q = motion(s, pace)[0]
    stations = Stations(q, np.round(begin + s, 6), np.zeros_like(q))
    return Plan(np.round(begin + fine, 6), *motion(fine, pace), stations=stations, ends=None)


def record(
    cell: Cell, plan: Plan, faults: tuple[Fault, ...], rng: np.random.Generator, bare: bool, first: bool
) -> tuple[Recording, float, float]:
    """What a recorder would have noted, the noise of its readings (RMS) [mm] and the seconds it took."""
    arm, stations, m = cell.arm, plan.stations, len(plan.stations.t)
    repeated = Stations(stations.q + rng.normal(0, REPEATABILITY, stations.q.shape), stations.t, stations.way)
    exact, seen = cell.poses(stations, faults), cell.poses(repeated, faults)
    p = seen.p + rng.normal(0, 1e-3 * NOISE_MM, (m, 3))
    floor = 1e3 * float(np.sqrt(np.mean(np.sum((p - exact.p) ** 2, axis=1))))
    if first:  # readings that are far off are part of no floor
        far = rng.choice(m, sum(f.outliers for f in faults), replace=False)
        ways = rng.normal(size=(len(far), 3))
        p[far] += rng.uniform(1e-3, 5e-3, (len(far), 1)) * ways / np.linalg.norm(ways, axis=1, keepdims=True)
    R = seen.R * Rotation.from_rotvec(rng.normal(0, 1e-3 * NOISE_MRAD, (m, 3)))
    # the whole recording carries what hangs at the flange, see Cell.poses
    effort = arm.driving(plan.q, plan.v, plan.a) + rng.normal(0, EFFORT_NOISE, plan.q.shape)
    q = plan.q.copy()
    for fault in faults:
        for i, late in fault.lag.items():
            q[:, i] = _earlier(plan, i, late)
    rows = plan.ends if bare and plan.ends is not None else np.arange(len(plan.t))
    if bare:
        effort = np.full_like(effort, np.nan)
    stamps = BEGIN + plan.t[rows]
    joints = JointTrack(arm.names, stamps, q[rows], plan.v[rows], effort[rows], stamps)
    late = BEGIN + stations.t + sum(f.latency for f in faults)
    readings = ReadingTrack(POSE, "tracker", late, np.concatenate([p, R.as_quat()], axis=1), late)
    signals = []
    for fault in faults:
        if fault.sensor is not None:
            link, temperature = fault.sensor
            clock = np.arange(plan.t[0], plan.t[-1] + 1.0)
            values = temperature(clock) + rng.normal(0, 0.05, len(clock))
            signals.append(SignalTrack(f"temperature:{link}", BEGIN + clock, values[:, None], "/temperature"))
    recording = Recording((joints,), (readings,), tuple(signals), arm.urdf)
    return recording, floor, float(plan.t[-1] - plan.t[0])


def _earlier(plan: Plan, i: int, late: float) -> Array:
    """A joint's positions some milliseconds ago, to the third order of a smooth course."""
    jerk = np.gradient(plan.a[:, i], plan.t)
    return plan.q[:, i] - late * plan.v[:, i] + late**2 / 2 * plan.a[:, i] - late**3 / 6 * jerk


def plant(cell: Cell, makers: tuple[Maker, ...], rng: np.random.Generator, duration: float) -> tuple[Fault, ...]:
    """Faults, drawn again while what is drawn cannot be seen in random postures after the best geometry."""
    q = rng.uniform(*cell.arm.range, (STATIONS, cell.arm.n))
    way = rng.choice([-1.0, 1.0], q.shape)
    draw = Draw(rng, cell.arm, q, duration)
    sample = Stations(q, np.linspace(0.0, duration, STATIONS), way)
    faults: list[Fault] = []
    for maker in makers:
        for _ in range(50):
            fault = maker(draw)
            of_readings = fault.silent or fault.latency or fault.lag or fault.outliers
            if of_readings or cell.size(sample, (fault,)).over_noise >= MIN:
                faults.append(fault)
                break
        else:
            raise RuntimeError(f"no {maker.__name__} of this arm can be seen")
    return tuple(faults)


@dataclass(frozen=True)
class Pair:
    """Two recordings of one cell and the truth about them."""

    first: Path
    second: Path
    truth: Path


def make(scenario: str, robot: str, seed: int, folder: Path, stations: int = STATIONS) -> Pair:
    """Write both bags of a scenario below folder/bags, and the truth below folder/truth."""
    name = f"{robot}_{seed}"  # the fault is not to be read off the bag's name
    rng = np.random.default_rng([zlib.crc32(f"{scenario} {robot}".encode()), seed])
    cell = Cell(robot, rng)
    makers = SCENARIOS[scenario]
    moving = any(maker.__name__ in MOVING for maker in makers)
    bare = not moving and rng.random() < 1 / 3
    plan = course(cell, rng, COURSE, 0.0) if moving else point_to_point(cell.arm, rng, stations, 0.0)
    faults = plant(cell, makers, rng, float(plan.t[-1]))
    begin = float(plan.t[-1]) + PAUSE
    if moving:  # noqa: SIM108
        again = course(cell, rng, COURSE_SECOND, begin)
    else:
        again = point_to_point(cell.arm, rng, STATIONS_SECOND, begin)
    bags = folder / "bags"
    pair = Pair(bags / f"{name}_first", bags / f"{name}_second", folder / "truth" / f"{name}.json")
    recording, _, duration = record(cell, plan, faults, rng, bare, True)
    second, floor, _ = record(cell, again, faults, rng, bare, False)
    truth = {
        "scenario": scenario,
        "robot": robot,
        "seed": seed,
        "only_stations": bare,
        "duration_s": duration,
        "effects": [
            {"family": f.family, "place": f.place, "driver": f.driver, "size": f.size} for f in faults if not f.silent
        ],
        "sizes": [asdict(s) for s in sizes(cell, plan, faults)],
        "floor_mm_second": floor,
    }
    pair.first.parent.mkdir(parents=True, exist_ok=True)
    pair.truth.parent.mkdir(parents=True, exist_ok=True)
    write_recording(recording, pair.first)
    write_recording(second, pair.second)
    pair.truth.write_text(json.dumps(truth, indent=1), encoding="utf-8")
    return pair


def sizes(cell: Cell, plan: Plan, faults: tuple[Fault, ...]) -> list[Size]:
    """How much each fault moves the tool at the stations of a plan."""
    out = []
    for fault in faults:
        if fault.latency or fault.lag:
            # what is reported for a moment belongs to another one
            lag = np.full(cell.arm.n, fault.latency)
            for i, late in fault.lag.items():
                lag[i] = -late
            v = np.stack([np.interp(plan.stations.t, plan.t, plan.v[:, i]) for i in range(cell.arm.n)], axis=1)
            s = plan.stations
            then = Stations(s.q + lag * v, s.t, s.way)
            out.append(cell.size_of(s, cell.poses(then, ()), cell.poses(s, ())))
        else:
            out.append(cell.size(plan.stations, (fault,)))
    return out

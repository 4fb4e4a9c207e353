"""A cell with planted faults: two recordings of it, and the truth about them."""

from __future__ import annotations

import json
import zlib
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import sites
from arms import Array
from scenarios import MOVING, SCENARIOS, Draw, Fault, Maker
from sites import BEGIN, EFFORT_NOISE, NOISE_MM, NOISE_MRAD, REPEAT, Cell, Plan, Seen, Stations, rms

from modcal_core.measurements.recording import JointTrack, Recording, SignalTrack
from modcal_msgs_py.recording_write import write_recording

STATIONS, STATIONS_SECOND = 160, 60
PAUSE = 120.0  # s between the two recordings
COURSE, COURSE_SECOND = 60.0, 40.0  # s
MIN = 2.5  # a planted fault stands out of the noise by this factor (RMS) after the best geometry


@dataclass(frozen=True)
class Size:
    """How much a fault moves the tool: RMS of the difference, and what of it no displacement of any body takes up."""

    mm: float
    mrad: float
    visible_mm: float
    visible_mrad: float

    @property
    def over_noise(self) -> float:
        return float(np.hypot(self.visible_mm / NOISE_MM, self.visible_mrad / NOISE_MRAD) / np.sqrt(6.0))


def size_of(cell: Cell, stations: Stations, with_: Seen, without: Seen) -> Size:
    """The size of the difference of poses, before and after displacing every body has taken up its part."""
    p, R = cell.arm.frames(cell.arm.coordinates(stations.q))
    at = (p[:, -1] + R[:, -1] @ cell.tool[0])[:, None]
    p = np.concatenate([np.zeros_like(p[:, :1]), p], axis=1)  # the base is a body as well
    R = np.concatenate([np.broadcast_to(np.eye(3), R[:, :1].shape), R], axis=1)
    lever = np.cross(R, (at - p)[..., None], axisa=-2, axisb=-2, axisc=-2)  # columns: axis × lever
    eye = cell.tracker[1].inv().as_matrix()
    A = np.block([[eye @ R, eye @ lever], [np.zeros_like(R), eye @ R]]).swapaxes(1, 2).reshape(6 * len(p), -1)
    raw = np.concatenate([with_.p - without.p, (with_.R * without.R.inv()).as_rotvec()], axis=1)
    rest = (raw.ravel() - A @ np.linalg.lstsq(A, raw.ravel(), rcond=1e-10)[0]).reshape(raw.shape)
    return Size(*(1e3 * rms(v[:, part]) for v in (raw, rest) for part in (slice(3), slice(3, 6))))


def plant(cell: Cell, makers: tuple[Maker, ...], rng: np.random.Generator, duration: float) -> tuple[Fault, ...]:
    """Faults, drawn again while what is drawn cannot be seen in random postures after the best geometry."""
    q = rng.uniform(*cell.arm.range, (STATIONS, cell.arm.n))
    sample = Stations(q, np.linspace(0.0, duration, STATIONS), rng.choice([-1.0, 1.0], q.shape))
    draw, faults = Draw(rng, cell.arm, q, duration), []
    for maker in makers:
        for _ in range(50):
            fault = maker(draw)
            if (fault.silent or fault.latency or fault.lag or fault.outliers) or (
                size_of(cell, sample, cell.poses(sample, [fault.bend]), cell.poses(sample)).over_noise >= MIN
            ):
                faults.append(fault)
                break
        else:
            raise RuntimeError(f"no {maker.__name__} of this arm can be seen")
    return tuple(faults)


def size(cell: Cell, plan: Plan, fault: Fault) -> Size:
    """How much a fault moves the tool at the stations of a plan."""
    s = plan.stations
    if not (fault.latency or fault.lag):
        return size_of(cell, s, cell.poses(s, [fault.bend]), cell.poses(s))
    # what is reported for a moment belongs to another one
    lag = np.array([-fault.lag.get(i, -fault.latency) for i in range(cell.arm.n)])
    v = np.stack([np.interp(s.t, plan.t, column) for column in plan.v.T], axis=1)
    return size_of(cell, s, cell.poses(replace(s, q=s.q + lag * v)), cell.poses(s))


def record(
    cell: Cell, plan: Plan, faults: tuple[Fault, ...], rng: np.random.Generator, bare: bool, first: bool
) -> tuple[Recording, float, float]:
    """What a recorder would have noted, the noise of its readings (RMS) [mm] and the seconds it took."""
    arm, stations, m, bends = cell.arm, plan.stations, len(plan.stations.t), [f.bend for f in faults]
    repeated = replace(stations, q=stations.q + rng.normal(0, REPEAT, stations.q.shape))
    exact, seen = cell.poses(stations, bends), cell.poses(repeated, bends)
    p = seen.p + rng.normal(0, 1e-3 * NOISE_MM, (m, 3))
    floor = 1e3 * rms(p - exact.p)
    if first:  # readings that are far off are part of no floor
        far = rng.choice(m, sum(f.outliers for f in faults), replace=False)
        ways = sites.unit(rng.normal(size=(len(far), 3)))
        p[far] += rng.uniform(1e-3, 5e-3, (len(far), 1)) * ways
    R = seen.R * sites.turn_noise(rng, 1e-3 * NOISE_MRAD, m)
    # the whole recording carries what hangs at the flange, see Cell.poses
    effort = arm.driving(plan.q, plan.v, plan.a) + rng.normal(0, EFFORT_NOISE, plan.q.shape)
    q = plan.q.copy()
    for i, late in [lag for fault in faults for lag in fault.lag.items()]:
        q[:, i] = _earlier(plan, i, late)
    rows = plan.ends if bare and plan.ends is not None else np.arange(len(plan.t))
    effort = np.full_like(effort, np.nan) if bare else effort
    stamps, late = BEGIN + plan.t[rows], BEGIN + stations.t + sum(f.latency for f in faults)
    joints = JointTrack(arm.names, stamps, q[rows], plan.v[rows], effort[rows], stamps)
    signals = []
    for link, temperature in [fault.sensor for fault in faults if fault.sensor is not None]:
        clock = np.arange(plan.t[0], plan.t[-1] + 1.0)
        values = temperature(clock) + rng.normal(0, 0.05, len(clock))
        signals.append(SignalTrack(f"temperature:{link}", BEGIN + clock, values[:, None], "/temperature"))
    recording = Recording((joints,), (sites.reading(late, sites.poses(p, R)),), tuple(signals), arm.urdf)
    return recording, floor, float(plan.t[-1] - plan.t[0])


def _earlier(plan: Plan, i: int, late: float) -> Array:
    """A joint's positions some milliseconds ago, to the third order of a smooth course."""
    jerk = np.gradient(plan.a[:, i], plan.t)
    return plan.q[:, i] - late * plan.v[:, i] + late**2 / 2 * plan.a[:, i] - late**3 / 6 * jerk


def make(scenario: str, robot: str, seed: int, folder: Path, stations: int = STATIONS) -> tuple[Path, Path, Path]:
    """Write both bags of a scenario below folder/bags, and the truth below folder/truth: their paths."""
    rng = np.random.default_rng([zlib.crc32(f"{scenario} {robot}".encode()), seed])
    cell, makers = Cell(robot, rng), SCENARIOS[scenario]
    moving = any(maker in MOVING for maker in makers)
    bare = not moving and rng.random() < 1 / 3

    def plan_of(seconds: float, count: int, begin: float) -> Plan:
        plan = sites.course(cell, rng, seconds, begin) if moving else sites.point_to_point(cell.arm, rng, count, begin)
        return replace(plan, stations=replace(plan.stations, path=(plan.t, plan.q)))

    plan = plan_of(COURSE, stations, 0.0)
    faults = plant(cell, makers, rng, float(plan.t[-1]))
    again = plan_of(COURSE_SECOND, STATIONS_SECOND, float(plan.t[-1]) + PAUSE)
    recording, _, duration = record(cell, plan, faults, rng, bare, True)
    second, floor, _ = record(cell, again, faults, rng, bare, False)
    named = [{k: getattr(f, k) for k in ("family", "place", "driver", "size")} for f in faults if not f.silent]
    truth: dict[str, Any] = {"scenario": scenario, "robot": robot, "seed": seed, "only_stations": bare}
    truth |= {"duration_s": duration, "effects": named, "floor_mm_second": floor}
    truth["sizes"] = [asdict(size(cell, plan, fault)) for fault in faults]
    name = f"{robot}_{seed}"  # the fault is not to be read off the bag's name
    for below in ("bags", "truth"):
        (folder / below).mkdir(parents=True, exist_ok=True)
    bags = folder / "bags" / f"{name}_first", folder / "bags" / f"{name}_second"
    for written, bag in zip((recording, second), bags, strict=True):
        write_recording(written, bag)
    told = folder / "truth" / f"{name}.json"
    told.write_text(json.dumps(truth, indent=1), encoding="utf-8")
    return *bags, told

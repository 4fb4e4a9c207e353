"""Recordings of the UR10 in MuJoCo, as finished stations or as streams, ready to be spoiled."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from cells import joint_track, record, ur10

from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import ReadingTrack, Recording
from modcal_nodes.simulation.mjcf import World
from modcal_nodes.simulation.program import Program, tour

URDF = Path(__file__).resolve().parents[2] / "examples" / "robots" / "ur10.urdf"
START = 1.7e9


@cache
def stations(count: int = 80, seed: int = 1) -> Recording:
    """A joint state and a pose with the same stamp, every two seconds."""
    made = record(seed, count)
    t = START + 2.0 * np.arange(count)
    T = se3.transform(made.samples.R, made.samples.reading)
    return recorded(t, made.samples.q, t, se3.to_pose(T))


@cache
def streams(
    count: int = 40, seed: int = 1, late: float = 0.0, dwell: float = 1.0, drift: float = 0.0, day: int = 0
) -> Recording:
    """Joint states at 125 Hz and poses at 50 Hz of an arm on its tour of a day; the tracker's stamps may be late."""
    rng = np.random.default_rng(seed)
    chain = ur10()
    world = World(chain, rng, T_tracker_base=se3.exp(rng.normal(size=6)), T_tip_tool=se3.exp([0.05, 0, 0.1, 0.2, 0, 0]))
    program = Program(np.zeros(6))
    rng = np.random.default_rng((seed, day)) if day else rng
    program.reset(0.0, tour(chain, count, 0.6, dwell, rng))
    t = np.arange(0.0, program.end, 0.008)
    s = np.arange(0.003, program.end, 0.02)
    T = world.tool_in_tracker(np.array([program.at(x) for x in s]))
    T[:, :3, 3] += 2e-5 * rng.standard_normal((len(s), 3))
    stamps = START + s + late + drift * s
    return recorded(START + t, np.array([program.at(x) for x in t]), stamps, se3.to_pose(T), received=START + s)


def recorded(t: Array, q: Array, s: Array, poses: Array, received: Array | None = None) -> Recording:
    """Joint states (n, 6) at t, and poses of the tool (m, 7) at s [s]."""
    return Recording(
        joints=(joint_track(ur10().names, t, q),),
        readings=(ReadingTrack("pose", "tracker", s, poses, s if received is None else received),),
        robot_description=URDF.read_text(),
        source="made",
    )


def part(whole: Recording, rows: slice) -> Recording:
    """Some joint states and readings of a recording of finished stations."""
    joints, reading = whole.joints[0], whole.readings[0]
    tracks = {name: getattr(joints, name)[rows] for name in ("stamps", "position", "velocity", "effort", "received")}
    readings = {name: getattr(reading, name)[rows] for name in ("stamps", "values", "received")}
    return with_reading(with_joints(whole, **tracks), **readings)


def with_joints(recording: Recording, **changes: Any) -> Recording:
    """The recording with its joint track changed."""
    return replace(recording, joints=(replace(recording.joints[0], **changes),))


def with_reading(recording: Recording, **changes: Any) -> Recording:
    """The recording with its reading track changed."""
    return replace(recording, readings=(replace(recording.readings[0], **changes),))

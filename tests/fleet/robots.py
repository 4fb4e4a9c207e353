"""A fleet in MuJoCo: recordings of two robots, one of them of no use."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from cells import NOISE_M, NOISE_RAD, record, ur10
from cli.recordings import START, stations, with_joints, with_reading

from modcal_core.geometry import se3, so3
from modcal_core.measurements.recording import Recording
from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.simulation.mjcf import World


def robot(seed: int) -> World:
    """An arm with errors of its own, before a tracker."""
    return record(seed, 2).world


def visit(world: World, seed: int, week: int, count: int = 50) -> Recording:
    """Stations of this arm so many weeks after the first."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-np.pi, np.pi, (count, 6))
    T = world.tool_in_tracker(q)
    T[:, :3, 3] += NOISE_M * rng.standard_normal((count, 3))
    T[:, :3, :3] = T[:, :3, :3] @ so3.exp(NOISE_RAD * rng.standard_normal((count, 3)))
    t = START + 604800.0 * week + 2.0 * np.arange(count)
    unknown = np.full_like(q, np.nan)
    form = stations(3)
    joints = with_joints(form, stamps=t, position=q, velocity=unknown, effort=unknown, received=t)
    return replace(with_reading(joints, stamps=t, values=se3.to_pose(T), received=t), robot_description=DESCRIPTION)


def write_fleet(folder: Path) -> None:
    """Two recordings of one robot, one of another, and one of four stations, which is of no use."""
    one, two = robot(11), robot(12)
    for k, week in enumerate((0, 1)):
        write_recording(visit(one, 20 + k, week), folder / "robot_1" / f"week_{week}")
    write_recording(visit(two, 30, 0), folder / "robot_2" / "week_0")
    write_recording(visit(two, 40, 5, count=4), folder / "robot_2" / "week_5")


DESCRIPTION = stations(3).robot_description
assert ur10().names == stations(3).joints[0].names

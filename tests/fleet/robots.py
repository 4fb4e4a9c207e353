"""A fleet in MuJoCo: robots that are visited now and then, some of which drift."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from cells import NOISE_M, NOISE_RAD, record, ur10
from cli.recordings import START, stations, with_joints, with_reading

from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import Recording
from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.simulation.world import World

WEEK = 604800.0
STILL = np.zeros(6)


def robot(seed: int) -> World:
    """An arm with errors of its own, before a tracker."""
    return record(seed, 2).world


def visit(world: World, seed: int, week: float, count: int = 50, base: Array = STILL) -> Recording:
    """Stations of this arm so many weeks after the first; base: by which twist of its own axes it has moved since."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-np.pi, np.pi, (count, 6))
    T_tracker_base = world.T_tracker_base
    T = T_tracker_base @ se3.exp(base) @ se3.inverse(T_tracker_base) @ world.tool_in_tracker(q)
    T[:, :3, 3] += NOISE_M * rng.standard_normal((count, 3))
    T[:, :3, :3] = T[:, :3, :3] @ so3.exp(NOISE_RAD * rng.standard_normal((count, 3)))
    t = START + week * WEEK + 2.0 * np.arange(count)
    unknown = np.full_like(q, np.nan)
    form = stations(3)
    joints = with_joints(form, stamps=t, position=q, velocity=unknown, effort=unknown, received=t)
    return replace(with_reading(joints, stamps=t, values=se3.to_pose(T), received=t), robot_description=DESCRIPTION)


def write_fleet(folder: Path) -> None:
    """Three visits of a robot whose base rises by 0.1 mm a week, two of one that stands still, and a bag of nothing."""
    drifting, still = robot(11), robot(12)
    for k, week in enumerate((0.0, 1.0, 3.0)):
        base = np.array([0.0, 0.0, 1e-4 * week, 0.0, 0.0, 0.0])
        write_recording(visit(drifting, 20 + k, week, base=base), folder / "robot_1" / f"week_{week:.0f}")
    for k, week in enumerate((0.0, 2.0)):
        write_recording(visit(still, 30 + k, week), folder / "robot_2" / f"week_{week:.0f}")
    write_recording(visit(still, 40, 5.0, count=4), folder / "robot_2" / "week_5")


DESCRIPTION = stations(3).robot_description
assert ur10().names == stations(3).joints[0].names

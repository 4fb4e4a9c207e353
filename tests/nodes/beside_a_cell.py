"""A calibrator beside a cell that a test plays, and the stations that it plays."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from cells import record, samples_of
from cli.recordings import START, URDF
from nodes.cell import PlayedCell
from nodes.processes import Process, Wait, beside
from nodes.talking import LATCHED, Diagnostics
from rclpy.node import Node
from std_msgs.msg import String

from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import JointTrack, ReadingTrack, Recording

STATIONS = 48
HEARING, MODEL, SAMPLES = (f"/calibrator: {part}" for part in ("hearing", "model", "samples"))
PANDA = URDF.with_name("panda.urdf")


def stations(count: int = STATIONS, seed: int = 1, begin: float = START, bump: Array | None = None) -> Recording:
    """Finished stations of one displaced arm: a joint state and a pose of the same stamp, two seconds apart."""
    cell = record(seed, count)
    T = se3.transform(cell.samples.R, cell.samples.reading)
    made = samples_of(cell.world.nominal, cell.samples.q, T if bump is None else T @ bump)
    t = begin + 2.0 * np.arange(count)
    unknown = np.full_like(made.q, np.nan)
    poses = se3.to_pose(se3.transform(made.R, made.reading))
    return Recording(
        (JointTrack(made.names, t, made.q, unknown, unknown, t),), (ReadingTrack("pose", "tracker", t, poses, t),)
    )


@contextlib.contextmanager
def beside_a_cell(
    folder: Path, urdf: Path = URDF, **parameters: Any
) -> Iterator[tuple[Process, Node, Wait, PlayedCell, Diagnostics]]:
    """A calibrator that has found a cell and heard its description; it must end well."""
    with beside(folder, "calibrator", **parameters) as (calibrator, node, wait):
        cell, said = PlayedCell(node), Diagnostics(node)
        wait(cell.heard, 60.0)
        cell.describe(urdf.read_text())
        yield calibrator, node, wait, cell, said
        assert calibrator.stop() == 0


def latched(node: Any, topic: str, kind: type = String) -> list[Any]:
    heard: list[Any] = []
    node.create_subscription(kind, topic, lambda m: heard.append(getattr(m, "data", m)), LATCHED)
    return heard


def children(pid: int) -> list[int]:
    """Processes that a process has started, resource trackers included."""
    try:
        return [int(p) for p in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except FileNotFoundError:
        return []


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False

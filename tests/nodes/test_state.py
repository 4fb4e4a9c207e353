"""What a calibrator keeps: on disk, held by one process; in memory, apart where the clock was set back."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from camera.boards import BOARD, facing, views
from cells import record
from geometry_msgs.msg import PoseStamped
from nodes.in_process import spun
from sensor_msgs.msg import JointState

from modcal_core.camera.target_file import scale_of_rulers
from modcal_core.errors import BadTable
from modcal_msgs_py.readings import set_seconds
from modcal_nodes.calibrating.buffer import Buffer
from modcal_nodes.calibrating.state import (
    State,
    StateLock,
    forget_images,
    read_images,
    read_state,
    write_images,
    write_state,
)
from modcal_nodes.nodes.calibrator import Calibrator


def test_damaged_stations_are_refused(tmp_path: Path) -> None:
    write_state(tmp_path, State(samples=record(3, 10).samples))
    file = tmp_path / "samples.npz"
    file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(BadTable, match=r"samples\.npz.*is damaged"):
        read_state(tmp_path)


HOLD = """
import sys, time
from pathlib import Path
from modcal_nodes.calibrating.state import StateLock
lock = StateLock(Path(sys.argv[1]))
print("held", flush=True)
time.sleep(60)
"""


@pytest.mark.slow
def test_a_folder_is_held_by_one_process_and_a_kill_frees_it(tmp_path: Path) -> None:
    folder = tmp_path / "state"
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(folder)], stdout=subprocess.PIPE, text=True)
    with holder:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(BadTable, match=f"is in use by process {holder.pid}: give each"):
            StateLock(folder)
        holder.kill()
    lock = StateLock(folder)
    assert read_state(folder).calibration is None  # the lock itself is no state
    lock.release()
    StateLock(folder).release()


@pytest.mark.dds
def test_a_second_calibrator_on_the_folder_does_not_start(tmp_path: Path) -> None:
    used = pytest.raises(BadTable, match=f"in use by process {os.getpid()}")
    with spun(Calibrator, state=tmp_path / "state"), used:
        Calibrator()
    with spun(Calibrator, state=tmp_path / "state"):
        pass


def test_images_come_back_as_they_were(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    seen = [replace(v, stamp=float(i)) for i, v in enumerate(views(rng, facing(rng, 4)))]
    images = [(v, rng.normal(size=7)) for v in seen]
    assert read_images(tmp_path / "state", BOARD) is None
    write_images(tmp_path / "state", images, (1280, 720), BOARD, True)
    kept = read_images(tmp_path / "state", BOARD)
    assert (kept.size, kept.trusted) == ((1280, 720), True)
    for (view, q), (expected, joints) in zip(kept.images, images, strict=True):
        assert (view.name, view.stamp) == (expected.name, expected.stamp)
        assert (view.ids == expected.ids).all()
        assert (view.pixels == expected.pixels).all()
        assert (view.cov == expected.cov).all()
        assert (q == joints).all()
    measured = replace(BOARD, scale=scale_of_rulers((0.2, 0.12), (0.201, 0.12), "rulers"))
    assert read_images(tmp_path / "state", measured) is not None  # the same sheet, measured since
    assert read_images(tmp_path / "state", replace(BOARD, square=0.031)) is None


def test_damaged_images_are_refused(tmp_path: Path) -> None:
    (tmp_path / "images.npz").write_bytes(b"PK")
    with pytest.raises(BadTable, match="damaged"):
        read_images(tmp_path, BOARD)
    forget_images(tmp_path)
    assert read_images(tmp_path, BOARD) is None


JOINTS, POSE = ("/joint_states", "sensor_msgs/msg/JointState"), ("/tracker/pose", "geometry_msgs/msg/PoseStamped")


def joint_states(stamps: np.ndarray) -> list[tuple[tuple[str, str], JointState]]:
    out = []
    for stamp in stamps:
        message = JointState(name=["a"], position=[0.1])
        set_seconds(message.header.stamp, float(stamp))
        out.append((JOINTS, message))
    return out


def poses(stamps: np.ndarray, frame: str = "tracker") -> list[tuple[tuple[str, str], PoseStamped]]:
    out = []
    for stamp in stamps:
        message = PoseStamped()
        message.header.frame_id = frame
        set_seconds(message.header.stamp, float(stamp))
        out.append((POSE, message))
    return out


FIRST, SECOND = 5000.0 + np.arange(30.0), 1000.0 + np.arange(30.0)
ORDERS = {
    "one by one": [m for t in (FIRST, SECOND) for pair in zip(joint_states(t), poses(t), strict=True) for m in pair],
    "readings first": [*joint_states(FIRST), *poses(FIRST), *poses(SECOND), *joint_states(SECOND)],
    "joint states first": [*joint_states(FIRST), *joint_states(SECOND), *poses(FIRST), *poses(SECOND)],
    "late and early": [*joint_states(FIRST), *poses(FIRST[:20]), *joint_states(SECOND[:10]), *poses(FIRST[20:]),
                       *poses(SECOND), *joint_states(SECOND[10:])],
}  # fmt: skip


@pytest.mark.parametrize("order", ORDERS)
def test_readings_stay_with_the_joint_states_of_their_time(order: str) -> None:
    memory = Buffer(1e4)
    for k, ((topic, kind), message) in enumerate(ORDERS[order]):
        memory.add(topic, kind, message, 1e4 + k)
    pieces = memory.collected().recordings
    assert [list(piece.joints[0].stamps) for piece in pieces] == [list(FIRST), list(SECOND)]
    assert [list(piece.readings[0].stamps) for piece in pieces] == [list(FIRST), list(SECOND)]


def test_a_trackers_own_clock_makes_no_pieces() -> None:
    """Its readings stay where they are, for what came of it is found out when clocks are aligned."""
    memory = Buffer(1e4)
    t = 5000.0 + 0.1 * np.arange(1500)
    both = zip(joint_states(t), poses(np.r_[t[:500], t[500:] - 2000.0]), strict=True)
    for (topic, kind), message in chain.from_iterable(both):
        memory.add(topic, kind, message, 1e4)
    (piece,) = memory.collected().recordings
    assert len(piece.joints[0].stamps) == len(piece.readings[0].stamps) == 1500


def test_pieces_end_when_they_are_long() -> None:
    memory = Buffer(20.0)
    for (topic, kind), message in joint_states(5000.0 + np.arange(50.0)):
        memory.add(topic, kind, message, 1e4)
    assert memory.pieces == 1  # the second may have readings to come
    assert [len(piece.joints[0].stamps) for piece in memory.collected().recordings] == [21, 21, 8]
    memory.condensed(1, None)
    assert [len(piece.joints[0].stamps) for piece in memory.collected().recordings] == [21, 8]


@pytest.mark.parametrize("offset", [0.0, -2000.0, 2000.0], ids=["one clock", "tracker behind", "tracker ahead"])
def test_readings_that_come_late_are_not_lost_where_a_long_piece_ends(offset: float) -> None:
    memory = Buffer(20.0)
    t = 5000.0 + 0.2 * np.arange(300)
    bursts = zip(np.split(t, 6), np.split(t + offset, 6), strict=True)
    for (topic, kind), message in chain.from_iterable((*joint_states(a), *poses(b)) for a, b in bursts):
        memory.add(topic, kind, message, 1e4)
    pieces = memory.collected().recordings
    assert sum(len(reading.stamps) for piece in pieces for reading in piece.readings) == 300
    if not offset:
        for piece in pieces:
            assert list(piece.readings[0].stamps) == list(piece.joints[0].stamps)

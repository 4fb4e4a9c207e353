"""What a calibrator keeps, on disk and in memory; and what a calibration adds to the tree of frames."""

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
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, TransformStamped
from nodes.in_process import spun
from nodes.processes import ROOT
from nodes.talking import LATCHED
from rclpy.logging import get_logger
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, String

from modcal_core.camera.target_file import scale_of_rulers
from modcal_core.errors import BadTable
from modcal_core.geometry import se3
from modcal_core.loop import calibrate
from modcal_core.online.supervisor import Policy, Supervisor
from modcal_core.robots.kinematics import chain_forward
from modcal_msgs_py.readings import set_seconds
from modcal_nodes.calibrating.diagnostics import collected
from modcal_nodes.calibrating.intake import Buffer
from modcal_nodes.calibrating.state import KeptImages, StateFolder, forget_images, read_images, write_images
from modcal_nodes.nodes.calibrator import Calibrator
from modcal_nodes.ros.tf_frames import (
    CALIBRATED,
    CORRECTED,
    TOOL,
    Frame,
    Parents,
    corrected_frame,
    filled,
    static_frames,
)


def test_damaged_stations_are_refused(tmp_path: Path) -> None:
    folder = StateFolder(str(tmp_path), get_logger("state"))
    folder.write({}, record(3, 10).samples)
    file = tmp_path / "samples.npz"
    with np.load(file) as stored:
        some = {name: values for name, values in stored.items() if name != "kind"}
    whole = file.read_bytes()
    np.savez(file, **some)
    with pytest.raises(BadTable, match=r"samples\.npz.*is damaged"):  # nothing takes the place of what is missing
        folder.read()
    file.write_bytes(whole[:200])
    with pytest.raises(BadTable, match=r"samples\.npz.*is damaged"):
        folder.read()
    folder.release()


HOLD = """
import sys, time
from rclpy.logging import get_logger
from modcal_nodes.calibrating.state import StateFolder
held = StateFolder(sys.argv[1], get_logger("state"))
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
            StateFolder(str(folder), get_logger("state"))
        holder.kill()
    held = StateFolder(str(folder), get_logger("state"))
    assert held.read().calibration is None  # the lock itself is no state
    held.release()
    StateFolder(str(folder), get_logger("state")).release()


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
    sizes = [(1280, 720), (0, 0), (640, 480)]
    write_images(tmp_path / "state", KeptImages([images, [], images[:2]], sizes, True), BOARD)
    kept = read_images(tmp_path / "state", BOARD)
    assert (kept.sizes, kept.trusted) == (sizes, True)
    assert list(map(len, kept.images)) == [4, 0, 2]
    for (view, q), (expected, joints) in zip(kept.images[0], images, strict=True):
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


URDF = (ROOT / "examples" / "robots" / "ur10.urdf").read_text()


@pytest.mark.slow
def test_the_frames_lead_from_the_tracker_to_what_it_sees() -> None:
    """Tracker → base → corrected tip → tool is what MuJoCo's tracker reads."""
    cell = record(3, 60)
    result = calibrate(cell.samples, cell.world.nominal, np.random.default_rng(0), look_for_effects=False)
    model = result.calibration.calibrated
    tracker, tool = static_frames(result.calibration)
    assert (tracker.parent, tracker.child) == (model.serial.base, f"{model.frames[0]}{CALIBRATED}")
    assert (tool.parent, tool.child) == (f"{model.serial.tip}{CORRECTED}", TOOL)
    for row in range(0, len(cell.samples), 7):
        tip = corrected_frame(model.serial.base, model.serial.tip, chain_forward(model.chain, cell.samples.q[row]))
        assert tip.child == tool.parent
        seen = se3.inverse(tracker.T) @ tip.T @ tool.T
        assert np.linalg.norm(seen[:3, 3] - cell.samples.reading[row]) < 5e-4
    message = filled(TransformStamped(), tracker, TransformStamped().header.stamp)
    p, o = message.transform.translation, message.transform.rotation
    assert np.allclose(se3.from_pose([p.x, p.y, p.z, o.x, o.y, o.z, o.w]), tracker.T, atol=1e-12)


def test_a_frame_that_has_a_parent_already_is_refused() -> None:
    frame, parents = Frame("base", "laser_calibrated", np.eye(4)), Parents()
    parents.require_free(frame)
    parents.receive([("base", "laser_calibrated")])  # as it comes back from the topic
    parents.require_free(frame)
    parents.receive([("/world", "/laser_calibrated")])
    with pytest.raises(BadTable, match="has the parent world already"):
        parents.require_free(frame)
    loop = Parents()
    loop.receive([("link", "base"), ("laser_calibrated", "link")])
    with pytest.raises(BadTable, match="is above base already"):
        loop.require_free(frame)


def test_how_far_collecting_is() -> None:
    supervisor = Supervisor(Policy(first_solve=40))
    supervisor.stations = 14
    assert collected(supervisor) == "14 of 40 stations, then it is solved"
    supervisor.policy = Policy(first_solve=0)
    assert collected(supervisor) == "14 of 40 stations, then call ~/solve"
    supervisor.stations = 44
    assert collected(supervisor) == "44 stations are collected, 40 are needed: call ~/solve"


@pytest.mark.dds
def test_what_is_missing_is_said_at_once(capfd: pytest.CaptureFixture[str]) -> None:
    """No description, then a tip that there is none of; whether a model is trusted is told from the start."""
    with spun(Calibrator, tip="nozzle", publish_tf=True) as pair:
        heard, trusted = pair.told(), list[bool]()
        pair.partner.create_subscription(Bool, "calibrator/trusted", lambda m: trusted.append(m.data), LATCHED)
        pair.wait(lambda: any("robot_description: not received yet" in s.message for s in heard), 3.0)
        pair.wait(lambda: trusted and pair.node._lacked, 3.0)
        assert trusted == [False]
        description = pair.partner.create_publisher(String, "robot_description", LATCHED)
        description.publish(String(data=URDF))
        joints = pair.partner.create_publisher(JointState, "joint_states", 10)
        pair.wait(joints.get_subscription_count, 5.0)
        joints.publish(JointState(name=[f"j{k}" for k in range(2)], position=[0.0, 0.0]))
        pair.wait(lambda: any("link 'nozzle': is not in the robot description" in s.message for s in heard), 3.0)
        worst = [s for s in heard if "nozzle" in s.message][-1]
        assert (worst.name, worst.level) == ("/calibrator: model", DiagnosticStatus.ERROR)
        pair.wait(lambda: pair.node._lacked.startswith("link 'nozzle'"), 3.0)
    log = capfd.readouterr().err
    assert "waiting: robot_description: not received yet" in log
    assert "waiting: link 'nozzle': is not in the robot description" in log
    assert "tf2_msgs is not installed" in log

"""What a calibration adds to the tree of frames, and what is said at once of what is missing."""

from __future__ import annotations

import numpy as np
import pytest
from cells import record
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from nodes.in_process import Pair, spun
from nodes.processes import ROOT
from nodes.talking import LATCHED
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, String

from modcal_core.errors import BadTable
from modcal_core.geometry import se3
from modcal_core.loop import calibrate
from modcal_core.online.supervisor import Policy, Supervisor
from modcal_core.robots.kinematics import chain_forward
from modcal_nodes.calibrating.diagnostics import collected
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
    with pytest.raises(BadTable, match="is not one of this package's"):
        parents.require_free(Frame("base", "tool0", np.eye(4)))


def test_how_far_collecting_is() -> None:
    supervisor = Supervisor(Policy(first_solve=40))
    supervisor.stations = 14
    assert collected(supervisor) == "14 of 40 stations, then it is solved"
    supervisor.policy = Policy(first_solve=0)
    assert collected(supervisor) == "14 of 40 stations, then call ~/solve"
    supervisor.stations = 44
    assert collected(supervisor) == "44 stations are collected, 40 are needed: call ~/solve"


def said(pair: Pair) -> list[DiagnosticStatus]:
    heard: list[DiagnosticStatus] = []
    pair.partner.create_subscription(DiagnosticArray, "/diagnostics", lambda m: heard.extend(m.status), 50)
    return heard


@pytest.mark.dds
def test_what_is_missing_is_said_at_once(capfd: pytest.CaptureFixture[str]) -> None:
    """No description, then a tip that there is none of; whether a model is trusted is told from the start."""
    with spun(Calibrator, tip="nozzle", publish_tf=True) as pair:
        heard, trusted = said(pair), list[bool]()
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

"""A robot description that is no robot's, by depth or size, is refused by every node and verb that reads one."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli.recordings import stations
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nodes.in_process import spun
from nodes.talking import LATCHED
from robots.test_urdf_size import row
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.cli.main import run
from modcal_nodes.nodes.acceleration_limits import AccelerationLimits
from modcal_nodes.nodes.articulation_estimator import ArticulationEstimator
from modcal_nodes.nodes.calibrator import Calibrator
from modcal_nodes.nodes.impedance_setpoint import ImpedanceSetpoint
from modcal_nodes.nodes.viewer import Viewer
from modcal_nodes.ros.guarded import GuardedNode

READERS = [AccelerationLimits, ArticulationEstimator, Calibrator, ImpedanceSetpoint, Viewer]
LARGE = row(3) + " " * 6_000_000


@pytest.mark.dds
@pytest.mark.parametrize("make", READERS)
def test_a_node_refuses_it_and_goes_on(make: type[GuardedNode]) -> None:
    """No fault, no delay: one sentence on /diagnostics; then a sound description is still taken up by the topic."""
    with spun(make, **({"autostart": True} if make is ImpedanceSetpoint else {})) as pair:
        heard: list[DiagnosticStatus] = []
        pair.partner.create_subscription(DiagnosticArray, "/diagnostics", lambda m: heard.extend(m.status), 50)
        description = pair.partner.create_publisher(String, "robot_description", LATCHED)
        joints = pair.partner.create_publisher(JointState, "joint_states", 10)
        pair.wait(lambda: description.get_subscription_count() and joints.get_subscription_count(), 5.0)
        for text, said in ((row(3000), "has 3001 links, 2000"), (row(600), "600 joints in a row"), (LARGE, "million")):
            description.publish(String(data=text))
            state = JointState(name=["j1", f"another {said}"], position=[0.0, 0.0])  # once anew: it is looked at again

            def told(said: str = said, state: JointState = state) -> bool:
                joints.publish(state)
                return any(said in s.message for s in heard)

            pair.wait(told, 5.0)
        assert not pair.node.faults.counts


def test_modcal_info_refuses_it(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """As the description of a bag, and as a file."""
    deep = tmp_path / "deep.urdf"
    deep.write_text(row(600))
    bag = tmp_path / "bag"
    write_recording(stations(12), bag)
    assert run(["info", str(bag), "--urdf", str(deep)]) == 2
    err = capfd.readouterr().err
    assert "robot description: has 600 joints in a row, 250 is the limit" in err
    assert "Traceback" not in err

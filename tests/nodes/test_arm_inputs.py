"""What a pull needs to hear of its arm: each of them, and lately."""

from __future__ import annotations

from typing import Any

import pytest
from geometry_msgs.msg import WrenchStamped
from impedance.toy import PANDA, READY
from nodes.pulled_arm import URDF
from sensor_msgs.msg import JointState

from modcal_core.errors import BadCommand
from modcal_msgs_py.readings import set_seconds
from modcal_nodes.setpoint.arm_inputs import ArmInputs

CHOSEN: dict[str, Any] = {
    "base": "", "tip": PANDA.tip, "wrench_frame": "", "tool_mass": 0.0, "tool_centre": [0.0, 0.0, 0.0],
    "cutoff_hz": 20.0, "wrench_by_tool": False, "timeout_s": 0.1, "calibrated": False,
}  # fmt: skip


def _heard(joints: float, wrench: float) -> ArmInputs:
    """An arm whose joints and wrist spoke last at these times [s]."""
    inputs = ArmInputs(URDF, CHOSEN)
    state = JointState(name=list(PANDA.names), position=READY.tolist())
    set_seconds(state.header.stamp, joints)
    inputs.take_joints(state, joints)
    force = WrenchStamped()
    force.header.frame_id = PANDA.tip
    set_seconds(force.header.stamp, wrench)
    inputs.take_wrench(force, wrench)
    return inputs


def test_an_arm_that_speaks_may_pull() -> None:
    _heard(10.0, 9.95).require_fresh(10.0)


@pytest.mark.parametrize(("joints", "wrench", "said"), [(10.0, 9.85, "wrench"), (9.85, 10.0, "joint")])
def test_an_arm_without_one_of_them_may_not(joints: float, wrench: float, said: str) -> None:
    with pytest.raises(BadCommand, match=said):
        _heard(joints, wrench).require_fresh(10.0)


def test_a_wrist_that_has_never_spoken_is_no_force_sensor() -> None:
    inputs = ArmInputs(URDF, CHOSEN)
    state = JointState(name=list(PANDA.names), position=READY.tolist())
    set_seconds(state.header.stamp, 10.0)
    inputs.take_joints(state, 10.0)
    with pytest.raises(BadCommand, match="wrench"):
        inputs.require_fresh(10.0)

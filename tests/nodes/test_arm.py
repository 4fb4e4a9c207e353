"""What a pull needs of its arm: fresh inputs, damping, an object in its frame, and servos that are stiff enough."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import WrenchStamped
from impedance.toy import PANDA, READY
from nodes.pulled_arm import URDF
from sensor_msgs.msg import JointState

from modcal_core.articulation.models.registry import axis_model
from modcal_core.articulation.urdf import describe, frames, read
from modcal_core.errors import BadCommand, ModcalError
from modcal_msgs_py.commands import ObjectInput
from modcal_msgs_py.readings import set_seconds
from modcal_nodes.ros.parameters import IMPEDANCE_SETPOINT
from modcal_nodes.setpoint import ArmInputs, JointSoftness, task

CHOSEN: dict[str, Any] = {
    "base": "", "tip": PANDA.tip, "wrench_frame": "", "tool_mass": 0.0, "tool_centre": [0.0, 0.0, 0.0],
    "cutoff_hz": 20.0, "wrench": "sensor", "wrench_by_tool": False, "timeout_s": 0.1, "calibrated": False,
}  # fmt: skip


def _heard(joints: float, wrench: float | None) -> ArmInputs:
    """An arm whose joints and wrist spoke last at these times [s], or never."""
    inputs = ArmInputs(URDF, CHOSEN)
    state = JointState(name=list(PANDA.names), position=READY.tolist())
    set_seconds(state.header.stamp, joints)
    inputs.take_joints(state, joints, pulls=False)
    if wrench is not None:
        force = WrenchStamped()
        force.header.frame_id = PANDA.tip
        set_seconds(force.header.stamp, wrench)
        inputs.take_wrench(force, wrench, pulls=False)
    return inputs


def test_an_arm_that_speaks_may_pull() -> None:
    _heard(10.0, 9.95).require_fresh(10.0)


@pytest.mark.parametrize(
    ("joints", "wrench", "said"), [(10.0, 9.85, "wrench"), (9.85, 10.0, "joint"), (10.0, None, "wrench")]
)
def test_an_arm_without_one_of_them_may_not(joints: float, wrench: float | None, said: str) -> None:
    with pytest.raises(BadCommand, match=said):
        _heard(joints, wrench).require_fresh(10.0)


DEFAULTS: dict[str, Any] = {name: parameter.default for name, parameter in IMPEDANCE_SETPOINT.items()}


@pytest.mark.parametrize(
    ("damping", "words"),
    [
        ([0.0, 0.0, 0.0], "at least 0.001"),
        ([0.0, 1000.0, 80.0], "at least 0.001"),
        ([1000.0, 50.0, 80.0], "damping across the pull 50: is below 90"),
        ([1000.0, 1000.0, 5.0], "damping of turning 5: is below 6"),
    ],
)
def test_damping_that_lets_contact_oscillate_is_refused(damping: list[float], words: str) -> None:
    with pytest.raises(ModcalError, match=words):
        task({**DEFAULTS, "damping": damping})
    task(DEFAULTS)


def test_damping_is_bounded_by_what_is_asked_of_the_stack() -> None:
    softer = {**DEFAULTS, "damping": [1000.0, 50.0, 80.0], "stack_stiffness": [1000.0, 200.0]}
    assert task(softer).damping[1] == 50.0


def _said(frame: str) -> SimpleNamespace:
    drawer = axis_model("prismatic").joint(np.eye(4), np.array([1.0, 0.0, 0.0]), np.zeros(3))
    return SimpleNamespace(data=describe(drawer, frame))


def test_an_object_in_another_frame_is_no_model() -> None:
    told = ObjectInput(read, frames)
    told.in_base("base_link")
    with pytest.raises(BadCommand, match="is in frame 'camera', the arm begins at 'base_link'"):
        told.hear_description(_said("camera"))
    assert told.model is None
    told.hear_description(_said("base_link"))
    assert told.model is not None
    assert not told.elsewhere


def test_an_object_that_was_described_before_the_arm_is_checked_when_that_is_known() -> None:
    told = ObjectInput(read, frames)
    told.hear_description(_said("camera"))
    assert told.model is not None
    told.in_base("base_link")
    assert told.model is None
    assert "camera" in told.elsewhere


def test_a_heartbeat_is_late_by_its_own_period() -> None:
    """One of 50 Hz after a quarter of a second, one of 2 Hz not before it is silent."""
    for period, late in ((0.02, True), (0.5, False)):
        told, message = ObjectInput(read, frames), SimpleNamespace(version=1, trusted=True, event="")
        message.model = SimpleNamespace(kind="prismatic")
        assert told.at(0.0).late
        for k in range(5):
            now = 10.0 + k * period
            message.header = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0))
            told.hear_status(message, now)
            assert not told.at(now + 0.2).late
        assert told.at(now + 0.9).late == late
        assert not told.silent
        assert told.at(now + 1.1).silent


def _with_effort(effort: str) -> str:
    """The efforts of the four strong joints are so; those of the wrist stay."""
    return re.sub(r'effort="87"', f'effort="{effort}"', URDF)


@pytest.mark.parametrize(
    ("effort", "lead", "strong", "wrist"),
    [
        ("87", 0.04, 2175.0, 300.0),
        ("87", 0.02, 4350.0, 600.0),
        ("0", 0.04, np.nan, 300.0),
        ("87", 0.0, np.nan, np.nan),
        ("-3", 0.04, np.nan, np.nan),
        ("12", 0.04, np.nan, np.nan),
    ],
)
def test_the_softest_that_a_servo_may_be_comes_from_the_effort_of_its_joint(
    effort: str, lead: float, strong: float, wrist: float
) -> None:
    """Where none is stated, or nonsense, or the same for all joints, or nobody says how servos lead, none is known."""
    found = JointSoftness.of(_with_effort(effort), PANDA, lead)
    assert found.least == pytest.approx(np.array([strong] * 4 + [wrist] * 3), nan_ok=True)
    assert bool(found.unknown) == bool(np.isnan(found.least).all())
    assert ("tool and joints" in found.said) == (not found.unknown)


def test_a_stack_that_holds_something_else_than_joints_is_not_judged_by_them() -> None:
    found = JointSoftness.of(URDF, PANDA, 0.04, held="mode is expected")
    assert np.isnan(found.least).all()
    assert found.said == "the lead of the tool alone (mode is expected)"

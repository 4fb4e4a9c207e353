"""The softest that an arm's servos may be: from the efforts of its URDF, where these say anything."""

from __future__ import annotations

import re

import numpy as np
import pytest
from impedance.toy import PANDA
from nodes.pulling import PANDA as PANDA_FILE

from modcal_nodes.setpoint.arm import JointSoftness

URDF = PANDA_FILE.read_text()


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

"""What a pull is not begun with: a damping that lets contact oscillate, and an object that is described elsewhere."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from modcal_core.articulation.models.registry import joint
from modcal_core.articulation.urdf import describe, frames, read
from modcal_core.errors import BadCommand, ModcalError
from modcal_msgs_py.commands import ObjectInput
from modcal_nodes.ros.parameters import IMPEDANCE_SETPOINT
from modcal_nodes.setpoint.arm import task

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
    drawer = joint("prismatic", np.eye(4), np.array([1.0, 0.0, 0.0]), np.zeros(3))
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

"""Where the tool is expected next: along a model, or, while the way is unknown, where it is led."""

from __future__ import annotations

import numpy as np
import pytest
from impedance.toy import PERIOD, T_READY, door, drawer

from modcal_core.articulation.models.registry import joint
from modcal_core.geometry import se3, so3
from modcal_core.impedance.path_model import Exploration, PathModel

BACK = T_READY[:3, :3].T @ np.array([-1.0, 0.0, 0.0])  # towards −x of the base, seen from the tool


@pytest.mark.parametrize("flip", [1.0, -1.0])
@pytest.mark.parametrize("kind", ["revolute", "prismatic", "screw"])
def test_it_opens_the_way_it_has_gone_whatever_sign_the_axis_has(kind: str, flip: float) -> None:
    truth = drawer() if kind == "prismatic" else door()
    axis, pitch = flip * truth.axis, 0.02 if kind == "screw" else 0.0
    model = joint(kind, T_READY, axis, truth.point, pitch)
    now = model.pose(flip * 0.1)
    course = PathModel(model, T_READY, now, now[:3, 3] - T_READY[:3, 3], 1.0, 0.3, 0.05)
    goal = course.goal_at
    assert goal == pytest.approx(flip * (0.3 if kind == "prismatic" else 1.0))
    assert course.opened(course.configuration(now)) == pytest.approx(0.1)
    before = course.pose(course.at)
    assert np.abs(before - now).max() < 1e-9
    after = course.advance(1e-4)
    step = after[:3, 3] - before[:3, 3]
    assert np.linalg.norm(step) == pytest.approx(1e-4, rel=1e-3)
    assert np.allclose(before[:3, :3] @ course.tangent(), step / np.linalg.norm(step), atol=1e-3)
    for _ in range(100):
        course.advance(0.01)
    assert course.left(course.at) == pytest.approx(-0.05)  # never farther than that beyond
    path = course.path()
    assert np.abs(path[-1] - model.pose(goal)).max() < 1e-9


def test_a_model_from_positions_leaves_a_tool_that_did_not_turn_as_it_is() -> None:
    """Held by a ball, or by a finger behind the handle: the position follows the arc, the orientation stays."""
    truth = door()
    model = joint("revolute", se3.transform(p=T_READY[:3, 3]), truth.axis, truth.point, oriented=False)
    now = se3.transform(T_READY[:3, :3], truth.pose(0.2)[:3, 3])
    course = PathModel(model, T_READY, now, now[:3, 3] - T_READY[:3, 3], 1.0, 0.3, 0.05)
    for T in course.path():
        assert np.abs(T[:3, :3] - T_READY[:3, :3]).max() < 1e-9
        assert np.linalg.norm(T[:3, 3] - truth.pose(truth.configuration(T[:3, 3]))[:3, 3]) < 1e-9
    assert np.linalg.norm(course.path()[-1][:3, 3] - truth.pose(1.0)[:3, 3]) < 1e-9


def test_what_seems_to_turn_about_an_axis_far_off_slides() -> None:
    """A drawer taken for a circle of 8 m is opened by 30 cm, not by 60° of that circle."""
    truth = door(8.0)
    course = PathModel(truth, T_READY, T_READY, np.array([-1.0, 0, 0]), 1.0, 0.3, 0.05)
    assert course.way == pytest.approx(0.3)


def test_a_pull_turns_towards_where_the_tool_is_led() -> None:
    """Along an arc, held so that the tool need not turn: the direction follows the tangent within some degrees."""
    truth, pulled = door(0.3), Exploration(T_READY, BACK)
    for a in np.arange(0.0, 0.8, 0.001):
        T = se3.transform(T_READY[:3, :3], truth.pose(a)[:3, 3])
        pulled.advance(0.0003, T, PERIOD)
    tangent = truth.pose(0.8)[:3, 3] - truth.pose(0.799)[:3, 3]
    assert pulled.moved @ tangent / np.linalg.norm(tangent) > np.cos(0.15)
    assert np.abs(pulled.pose[:3, :3] - T_READY[:3, :3]).max() < 1e-9
    assert np.linalg.norm(pulled.pose[:3, 3] - truth.pose(0.8)[:3, 3]) < 0.02


def test_a_pull_is_led_aside_no_faster_than_it_explores() -> None:
    """A tool that is found 30 mm beside the way at once: the expected pose comes over there, but is not swung across."""
    pulled, there = Exploration(T_READY, BACK, 0.03), se3.transform(p=[0.0, 0.03, 0.0]) @ T_READY
    way = [T_READY[:3, 3], *(pulled.advance(0.0, there, PERIOD)[:3, 3] for _ in range(600))]
    speeds = np.linalg.norm(np.diff(way, axis=0), axis=1) / PERIOD
    assert speeds.max() == pytest.approx(0.03)
    assert way[-1] - T_READY[:3, 3] == pytest.approx([0.0, 0.027, 0.0], abs=1e-4)


def test_a_model_from_positions_turns_the_tool_with_it() -> None:
    truth = door()
    model = joint("revolute", se3.transform(p=T_READY[:3, 3]), truth.axis, truth.point, oriented=False)
    now = truth.pose(0.2)
    course = PathModel(model, T_READY, now, now[:3, 3] - T_READY[:3, 3], 1.0, 0.3, 0.05)
    while course.left(course.at) > 0.0:
        T = course.advance(0.01)
    assert np.abs(T - truth.pose(course.opened(course.at))).max() < 1e-9


def test_a_hand_is_not_turned_on_by_what_its_servos_yield() -> None:
    """A ball grasp has no moment; the pull turns the measured hand by 3° against the servos, however it is sent."""
    sags = se3.transform(so3.exp([0.0, np.radians(3.0), 0.0]))
    kept, followed = Exploration(T_READY, BACK), Exploration(T_READY, BACK)
    for _ in range(1000):
        kept.advance(1e-5, kept.pose @ sags, PERIOD, kept.pose)
        followed.advance(1e-5, followed.pose @ sags, PERIOD)
    turned = [float(np.linalg.norm(so3.log(T_READY[:3, :3].T @ e.pose[:3, :3]))) for e in (kept, followed)]
    assert turned[0] < 1e-9
    assert turned[1] > np.radians(20.0)
    led = Exploration(T_READY, BACK)  # by a hinge: the moment is given way to, and the setpoint turns
    for _ in range(500):
        led.advance(1e-5, T_READY @ sags, PERIOD, T_READY @ sags)
    assert np.linalg.norm(so3.log(T_READY[:3, :3].T @ led.pose[:3, :3])) == pytest.approx(np.radians(3.0), rel=0.05)

"""Where the tool is expected next and at what pace, by a stop that is worked out step by step."""

from __future__ import annotations

import math

import numpy as np
import pytest
from impedance.toy import PERIOD, T_READY, door, drawer

from modcal_core.articulation.models.registry import axis_model
from modcal_core.geometry import se3, so3
from modcal_core.impedance.path_model import Exploration, PathModel
from modcal_core.impedance.speed_governor import ForcePrediction, GovernorSettings, SpeedGovernor

BACK = T_READY[:3, :3].T @ np.array([-1.0, 0.0, 0.0])  # towards −x of the base, seen from the tool


@pytest.mark.parametrize("flip", [1.0, -1.0])
@pytest.mark.parametrize("kind", ["revolute", "prismatic", "screw"])
def test_it_opens_the_way_it_has_gone_whatever_sign_the_axis_has(kind: str, flip: float) -> None:
    truth = drawer() if kind == "prismatic" else door()
    axis, pitch = flip * truth.axis, 0.02 if kind == "screw" else 0.0
    model = axis_model(kind).joint(T_READY, axis, truth.point, pitch)
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
    model = axis_model("revolute").joint(se3.transform(p=T_READY[:3, 3]), truth.axis, truth.point, oriented=False)
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


_STEP = 1e-5  # s
_BRAKE = 2.0  # m/s²


def stopped(speed: float, delay: float, contact: float, servo: float, mass: float) -> float:
    """Largest force [N] on a contact that a mass meets at a speed, pulled by a servo whose reference goes on for a
    delay, less the servo's lag, and then brakes.
    """
    lag = min(0.03, delay)
    t, x, v, ahead, pace, peak = 0.0, 0.0, speed, lag * speed, speed, 0.0
    while t < delay + 0.2:
        pace = max(pace - _BRAKE * _STEP, 0.0) if t >= delay - lag else pace
        ahead += pace * _STEP
        v += (servo * (ahead - x - lag * v) - contact * x) / mass * _STEP
        x += v * _STEP
        t += _STEP
        peak = max(peak, contact * x)
    return peak


@pytest.mark.parametrize("delay", [0.047, 0.2])
@pytest.mark.parametrize("servo", [8e3, 150e3])
@pytest.mark.parametrize("contact", [3e3, 20e3, 700e3])
def test_at_the_speed_in_sight_a_hard_stop_comes_to_no_more_than_the_last_force(
    contact: float, servo: float, delay: float
) -> None:
    """And to no more than 1.2 times as much where it is seen 50 ms later."""
    force, mass, governor = 8.0, 8.0, SpeedGovernor(GovernorSettings(contact_stiffness=contact), brake=_BRAKE)
    governor.touch(0.0, np.zeros(3))
    governor.touch(2.0, np.array([2.0 / contact, 0.0, 0.0]))
    assert governor.contact == contact
    speed = governor.in_sight(force, delay, servo, mass)
    felt, hidden = (force + stopped(speed, late, contact, servo, mass) for late in (delay, delay + 0.05))
    assert felt <= 50.0
    assert hidden <= 60.0
    assert max(felt / 50.0, hidden / (60.0 - min(2e-4 * servo, 20.0))) > 0.65  # and no slower than that takes


@pytest.mark.parametrize(("fingers", "known"), [(3e3, 20e3), (20e3, 20e3), (700e3, 700e3), (0.0, 700e3)])
def test_the_first_touch_tells_whether_fingers_are_as_soft_as_is_stated(
    fingers: float, known: float, rng: np.random.Generator
) -> None:
    """Of a drawer that 3 N move; one that none do (0) tells nothing."""
    governor = SpeedGovernor(GovernorSettings())
    for k in range(500):
        way = 1e-5 * k
        force = min(fingers * way, 3.0) + 0.1 * rng.normal()
        governor.touch(abs(force), np.array([way, 0.0, 0.0]))
    assert governor.contact == known


def test_a_force_that_rises_steadily_is_foreseen() -> None:
    """F = r t along one direction, and a moment that falls: F + r s and the moment as it is."""
    foresight, rate, ahead = ForcePrediction(), 700.0, 0.06
    along, about = np.array([2.0, -1.0, 2.0]) / 3.0, np.array([0.0, 0.6, 0.8])
    for k in range(1, 60):
        t = 0.002 * k
        F = np.concatenate([rate * t * along, (9.0 - 20.0 * t) * about])
        seen = foresight.ahead(F, t, ahead)
    assert seen[:3] == pytest.approx(rate * (t + ahead) * along, rel=1e-3)
    assert seen[3:] == pytest.approx(F[3:])


@pytest.mark.parametrize(("force", "most"), [(44.0, 0.02), (44.0, 4e-3), (20.0, 0.02), (47.5, 0.02)])
def test_the_slower_of_what_is_felt_and_what_is_in_sight_counts_and_not_both(force: float, most: float) -> None:
    """Up to 30 N the whole speed, none from 47.5 N on; a lower limit is no reason to go at a share of it."""
    pace, F = SpeedGovernor(GovernorSettings()), np.array([0.0, 0.0, force, 0.0, 0.0, 0.0])
    for _ in range(1000):
        way = pace.step(0.03, most, F, 0.004)
    share = min(1.0, (47.5 - force) / (47.5 - 30.0))
    assert way / 0.004 == pytest.approx(min(0.03 * share, most))


def test_late_inputs_slow_down_at_once_and_for_a_while() -> None:
    pace = SpeedGovernor(GovernorSettings())
    pace.heed(0.11, 0.004)
    assert pace.caution == pytest.approx(3.0)
    for _ in range(1000):  # four seconds
        way = pace.step(0.03, math.inf, np.zeros(6), 0.004)
        pace.heed(0.01, 0.004)
    assert way / 0.004 == pytest.approx(0.03, rel=0.01)

"""Between a computed command and an arm: limits, speed, side of arrival, and no jump when a calibration is replaced."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibration.test_effects import started
from cells import ur10
from correction.test_compensation import STEEP, calibration_of, true_model

from modcal_core.correction.commander import Bounds, CalibratedRobot, Commander, CommanderSettings, SetpointStream
from modcal_core.correction.correction import ArmState, Correction
from modcal_core.errors import BadCommand, BadRobot, NotReachable
from modcal_core.geometry import se3
from modcal_core.robots.chain import Chain

AT = np.array([0.3, -1.2, 1.4, -0.8, 1.1, 0.2])


def robot(*amplitudes: float, chain: Chain | None = None) -> CalibratedRobot:
    made = calibration_of(true_model(STEEP.started(np.array(amplitudes))))
    return CalibratedRobot(Correction(made), chain or ur10(), 3.0)


def test_bounds_are_the_narrower_of_what_is_described_and_calibrated() -> None:
    narrow = replace(ur10(), lower=np.full(6, -1.0), upper=np.full(6, 9.0))
    bounds = Bounds.of((narrow, ur10()), 0.5, 0.1)
    assert bounds.lower.tolist() == [-1.0] * 6
    assert bounds.upper.tolist() == ur10().upper.tolist()
    with pytest.raises(BadCommand, match=r"command -1.2000 of joint shoulder_lift_joint"):
        bounds.require_within(AT)
    for nothing in (np.nan, np.inf):
        with pytest.raises(BadCommand, match="not finite"):
            bounds.require_within(np.full(6, nothing))


def test_a_step_is_as_long_as_the_speed_allows() -> None:
    bounds = Bounds.of((ur10(),), 0.5, 0.1)
    step = np.zeros(6)
    step[4] = -0.05
    bounds.require_step(AT + 0.999 * step, AT, 0.1)
    with pytest.raises(BadCommand, match="wrist_2_joint"):
        bounds.require_step(AT + 1.001 * step, AT, 0.1)
    with pytest.raises(BadCommand):
        bounds.require_step(np.full(6, np.nan), AT, 0.1)
    assert bounds.seconds(AT + 10.0 * step, AT) == pytest.approx(1.0)


def test_a_change_comes_in_without_a_jump_of_position_or_speed() -> None:
    stream, dt = SetpointStream(), 0.01
    stream.given(np.zeros(1), 0.0)
    stream.take_over(np.array([1e-3]), 0.0, 2e-3, 0.5)
    sent = []
    for k in range(1, 80):
        q = stream.setpoint(np.array([1e-3]), k * dt)
        stream.given(q, k * dt)
        sent.append(float(q[0]))
    steps = np.diff([0.0, *sent])
    assert sent[-1] == 1e-3
    assert (steps >= 0.0).all()
    # the steepest point of a cubic blend is 1.5 times the mean
    assert steps.max() <= 1.5 * 1e-3 * dt / 0.5 + 1e-12
    assert np.abs(np.diff([0.0, *steps])).max() < 6.5 * 1e-3 * (dt / 0.5) ** 2


def test_too_large_a_change_is_refused_while_streaming_and_taken_in_a_pause() -> None:
    stream = SetpointStream()
    stream.given(np.zeros(1), 10.0)
    with pytest.raises(BadCommand, match="moves a joint by 0.0100"):
        stream.take_over(np.array([1e-2]), 10.1, 2e-3, 0.5)
    assert stream.setpoint(np.array([0.5]), 10.1)[0] == 0.5, "a refusal changes nothing"
    stream.take_over(np.array([1e-2]), 11.0, 2e-3, 0.5)
    assert stream.setpoint(np.array([1e-2]), 11.0)[0] == 1e-2
    # a clock that jumped back is no running stream
    assert not stream.running(5.0)


def test_a_commander_changes_calibration_in_a_stream_without_a_jump() -> None:
    settings = CommanderSettings(stream=True, horizon=0.2, blend=0.3)
    commander = Commander(settings)
    first, second = robot(1e-4, 2e-4), robot(-1e-4, 1e-4)
    assert commander.use(first, 0.0)
    wish = first.correction.pose(AT, ArmState.at_rest(AT, 0.0))
    sent = []
    for k in range(100):
        now = 100.0 + 0.01 * k
        at = ArmState.at_rest(AT, now)
        if k == 20:
            assert not commander.use(second, now), "it must wait for a setpoint"
        commander.change_over(at, now)
        setpoint = commander.setpoint(wish, "", at, now)
        commander.sent(setpoint, now)
        sent.append(setpoint.q)
    assert commander.robot is second
    assert np.abs(np.diff(sent, axis=0)).max() < 2e-5
    assert np.abs(sent[-1] - sent[0]).max() > 5e-5
    reached = second.correction.pose(sent[-1], ArmState.at_rest(sent[-1], 101.0))
    assert np.abs(reached - wish).max() < 1e-9


def test_a_commander_keeps_to_limits_that_only_the_description_knows() -> None:
    narrow = replace(ur10(), upper=np.array([0.31, *ur10().upper[1:]]))
    commander = Commander(CommanderSettings(), robot(1e-4, 2e-4, chain=narrow))
    for beyond, allowed in ((0.005, True), (0.02, False)):
        there = AT + beyond
        wish = commander.robot.correction.pose(there, ArmState.at_rest(there, 0.0))
        if allowed:
            assert np.abs(commander.setpoint(wish, "", ArmState.at_rest(AT, 0.0), 0.0).q - there).max() < 1e-6
        else:
            with pytest.raises(BadCommand, match="shoulder_pan_joint"):
                commander.setpoint(wish, "", ArmState.at_rest(AT, 0.0), 0.0)


def test_a_commander_without_a_robot_or_a_way_refuses() -> None:
    commander = Commander(CommanderSettings(stream=True))
    at = ArmState.at_rest(AT, 0.0)
    with pytest.raises(BadCommand, match="no command is corrected"):
        commander.setpoint(np.eye(4), "", at, 0.0)
    commander.use(robot(1e-4, 2e-4), 0.0)
    with pytest.raises(NotReachable):
        commander.setpoint(se3.transform(p=[1.5, 1.0, 0.9]), "", at, 0.0)
    straight = np.array([0.3, -1.2, 0.0, -0.8, 1.1, 0.2])
    wish = commander.robot.correction.pose(straight, ArmState.at_rest(straight, 0.0))
    with pytest.raises((BadCommand, NotReachable)):
        commander.setpoint(wish, "", ArmState.at_rest(straight + 1e-4, 0.0), 0.0)


def test_a_robot_must_be_the_one_that_was_calibrated() -> None:
    made = calibration_of(true_model(started("gear")))
    with pytest.raises(BadRobot):
        CalibratedRobot.of(made, "<robot name='r'><link name='base_link'/></robot>")


def test_a_joint_that_does_not_move_keeps_the_side_it_came_from() -> None:
    at = ArmState.at_rest([0.1, 0.2, 0.3, 0.4], 5.0, approach=[1.0, -1.0, 1.0, 0.0])
    there = at.arriving(at.q + [0.0, 0.0, -0.2, 0.3])
    assert there.approach.tolist() == [1.0, -1.0, -1.0, 1.0]
    assert np.array_equal(there.velocity, np.zeros(4))

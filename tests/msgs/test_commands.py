"""Wishes and joint states at the door: what is wrong, old or of another clock changes nothing."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from modcal_core.errors import BadCommand
from modcal_core.robots import Follower
from modcal_msgs_py.commands import JointInput, desired_pose, require_new


def stamped(stamp: float, **parts: Any) -> SimpleNamespace:
    whole = int(stamp // 1)
    time = SimpleNamespace(sec=whole, nanosec=round((stamp - whole) * 1e9))
    return SimpleNamespace(header=SimpleNamespace(stamp=time, frame_id=""), **parts)


def states(stamp: float, **joints: float) -> SimpleNamespace:
    return stamped(stamp, name=list(joints), position=list(joints.values()), velocity=[], effort=[])


def arm() -> JointInput:
    return JointInput(("a", "b"), np.array([-1.0, -2.0]), np.array([1.0, 2.0]))


@pytest.mark.slow
@pytest.mark.parametrize(("value", "believed"), [(1.05, True), (-1.05, True), (1.2, False), (-1.2, False)])
def test_a_joint_far_outside_its_limits_is_not_believed(value: float, believed: bool) -> None:
    heard = arm()
    heard.receive(states(10.0, a=0.5, b=0.0), 10.0, 0.1)
    if believed:
        heard.receive(states(10.0, a=value), 10.0, 0.1)
        assert heard.position[0] == value
    else:
        with pytest.raises(BadCommand, match="joint_states of a: .* is far outside its limits"):
            heard.receive(states(10.0, a=value), 10.0, 0.1)
        assert heard.position[0] == 0.5


def test_a_joint_that_mimics_another_stands_where_its_leader_puts_it_unless_it_is_named() -> None:
    follows = (Follower(1, "a", -2.0, 0.5), Follower(2, "rod", 3.0, 0.0))
    heard = JointInput(("a", "b", "c"), np.full(3, -5.0), np.full(3, 5.0), follows)
    message = stamped(10.0, name=["rod", "a"], position=[0.2, 0.3], velocity=[1.0, 2.0], effort=[7.0, 8.0])
    heard.receive(message, 10.0, 0.1)
    assert heard.complete
    assert np.allclose(heard.position, [0.3, -0.1, 0.6])
    assert np.allclose(heard.velocity, [2.0, -4.0, 3.0])
    assert heard.effort[0] == 8.0
    assert np.isnan(heard.effort[1:]).all(), "the drive is the leader's"
    heard.receive(states(10.0, a=0.3, b=0.4), 10.0, 0.1)
    assert heard.position[1] == 0.4
    with pytest.raises(BadCommand, match="joint_states of b: .* is far outside its limits"):
        heard.receive(states(10.0, a=4.0), 10.0, 0.1)


@pytest.mark.slow
@pytest.mark.parametrize("late", [-0.2, 0.2])
def test_joint_states_of_another_time_are_refused(late: float) -> None:
    with pytest.raises(BadCommand, match="old" if late < 0.0 else "ahead"):
        arm().receive(states(10.0 + late, a=0.0, b=0.0), 10.0, 0.1)


def test_messages_of_other_joints_in_turn_are_told_apart() -> None:
    """Names of the last message are remembered: others, in another order, or twice the same one, are looked at anew."""
    heard = arm()
    for names, q in (("ab", (0.1, 0.2)), ("ba", (0.3, 0.4)), ("b", (0.5,)), ("xy", (9.0, 9.0)), ("ab", (0.6, 0.7))):
        heard.receive(stamped(1.0, name=list(names), position=list(q), velocity=[], effort=[]), 1.0, 0.1)
        told = dict(zip(names, q, strict=True))
        for j, name in enumerate("ab"):
            assert heard.position[j] == told.get(name, heard.position[j])
    assert heard.position.tolist() == [0.6, 0.7]
    assert heard.complete
    for _ in range(2):
        with pytest.raises(BadCommand, match="2 positions for 2 names"):
            heard.receive(stamped(1.0, name=["a", "a"], position=[0.0, 1.0], velocity=[], effort=[]), 1.0, 0.1)
        with pytest.raises(BadCommand, match="1 positions for 2 names"):
            heard.receive(stamped(1.0, name=["a", "b"], position=[0.0], velocity=[], effort=[]), 1.0, 0.1)
    assert heard.position.tolist() == [0.6, 0.7]


def test_an_arm_is_as_fresh_as_its_oldest_joint() -> None:
    heard = arm()
    heard.receive(states(10.0, a=0.0, b=0.0), 10.0, 0.1)
    heard.receive(states(10.5, b=0.0), 10.5, 0.1)
    heard.require_fresh(10.05, 1.0)
    with pytest.raises(BadCommand, match=r"joint_states of a: are 0.5 s off, 0.1 s is the limit"):
        heard.require_fresh(10.5, 0.1)


@pytest.mark.slow
@pytest.mark.parametrize(("stamp", "passes"), [(10.0, True), (9.95, True), (10.05, True), (9.8, False), (10.2, False)])
def test_a_wish_is_of_now(stamp: float, passes: bool) -> None:
    if passes:
        require_new(stamped(stamp), 10.0, 0.1)
    else:
        with pytest.raises(BadCommand, match="its stamp is 0.2 s"):
            require_new(stamped(stamp), 10.0, 0.1)
    require_new(stamped(0.0), 10.0, 0.1)  # without a stamp it counts as sent now


@pytest.mark.slow
@pytest.mark.parametrize(("length", "passes"), [(1.0, True), (1.0005, True), (0.0, False), (0.9, False), (2.0, False)])
def test_a_quaternion_has_unit_length(length: float, passes: bool) -> None:
    p = SimpleNamespace(x=0.3, y=0.0, z=0.5)
    q = SimpleNamespace(x=0.6 * length, y=0.0, z=0.8 * length, w=0.0)
    message = SimpleNamespace(pose=SimpleNamespace(position=p, orientation=q))
    if passes:
        assert desired_pose(message, 2.0)[:3, 3].tolist() == [0.3, 0.0, 0.5]
    else:
        with pytest.raises(BadCommand, match="its quaternion has length"):
            desired_pose(message, 2.0)

"""Commanded joints in bags; wishes and joint states at the door, of which wrong or old ones change nothing."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from msgs import bag_forms as forms
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from modcal_core.errors import BadCommand
from modcal_core.measurements.recording import Recording, commanded_at
from modcal_core.robots import Follower
from modcal_msgs_py.commands import JointInput, desired_pose, require_new
from modcal_msgs_py.layout import definition, message_class
from modcal_msgs_py.mcap_read import read_recording

NAMES = ["a", "b"]
STATE = "control_msgs/msg/JointTrajectoryControllerState"
# control_msgs of Jazzy, without what it says of several axes
FIELDS = """std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint reference
trajectory_msgs/JointTrajectoryPoint feedback
trajectory_msgs/JointTrajectoryPoint error
trajectory_msgs/JointTrajectoryPoint output
"""
OLDER = (
    FIELDS.replace("reference", "desired")
    .replace("feedback", "actual")
    .replace("trajectory_msgs/JointTrajectoryPoint output\n", "")
)


def header(t: float) -> Any:
    return forms.header(round(t * 1e9))


def point(x: list[float], at: float = 0.0) -> Any:
    none = np.empty(0)
    duration = message_class("builtin_interfaces/msg/Duration")(sec=int(at), nanosec=round(at % 1 * 1e9))
    return message_class("trajectory_msgs/msg/JointTrajectoryPoint")(
        positions=np.array(x), velocities=none, accelerations=none, effort=none, time_from_start=duration
    )


def trajectory(t: float, points: list[Any]) -> Any:
    return message_class("trajectory_msgs/msg/JointTrajectory")(header=header(t), joint_names=NAMES, points=points)


def joint_state(t: float, x: list[float]) -> Any:
    return forms.joint_state(round(t * 1e9), NAMES, x)


def bag(path: Path, messages: list[tuple[float, str, str, Any]], store: Any = None, text: str = "") -> Path:
    """An MCAP file of (time [s], topic, type, message)."""
    timed = [(topic, kind, message, round(t * 1e9)) for t, topic, kind, message in messages]
    return forms.mcap_file(path, timed, {STATE: ("ros2msg", text)}, store)


def at(recording: Recording, stamps: list[float]) -> list[list[float]]:
    return commanded_at(recording.commands, ("a", "b"), np.array(stamps)).round(6).tolist()


def test_a_trajectory_is_followed_until_the_next_one_begins(tmp_path: Path) -> None:
    kind = "trajectory_msgs/msg/JointTrajectory"
    messages = [
        (10.0, "/joint_commands", kind, trajectory(10.0, [point([0.0, 1.0], 0.0), point([1.0, 1.0], 2.0)])),
        # without a stamp it begins when it comes; from where the one before had come to
        (11.0, "/joint_commands", kind, trajectory(0.0, [point([0.5, 2.0], 1.0)])),
        (20.0, "/joint_commands", kind, trajectory(20.0, [point([9.0], 1.0)])),  # numbers for one of two joints
        (21.0, "/joint_commands", kind, trajectory(21.0, [point([9.0, 9.0], 2.0), point([8.0, 8.0], 1.0)])),
    ]
    recording = read_recording(bag(tmp_path / "bag.mcap", messages))
    assert at(recording, [10.5, 11.5, 12.0, 30.0]) == [[0.25, 1.0], [0.5, 1.5], [0.5, 2.0], [0.5, 2.0]]
    assert recording.signals == ()


def test_commands_are_joint_states_of_their_own_and_stand_before_a_controllers(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(FIELDS, STATE))
    kind = "sensor_msgs/msg/JointState"
    state = store.types[STATE]

    def of_controller(t: float, x: list[float]) -> Any:
        return state(header(t), NAMES, point(x), point([7.0, 7.0]), point([0.0, 0.0]), point([]))

    messages = [
        (1.0, "/joint_states", kind, joint_state(1.0, [0.1, 0.2])),
        (1.0, "/arm_controller/controller_state", STATE, of_controller(1.0, [0.3, 0.4])),
        (2.0, "/joint_commands", kind, joint_state(2.0, [0.5, 0.6])),
    ]
    recording = read_recording(bag(tmp_path / "bag.mcap", messages, store, definition_text(FIELDS)))
    assert [track.topic for track in recording.joints] == ["/joint_states"]
    assert [track.topic for track in recording.commands] == ["/joint_commands", "/arm_controller/controller_state"]
    assert at(recording, [1.5, 2.5]) == [[0.3, 0.4], [0.5, 0.6]]
    assert recording.signals == ()


def test_a_controllers_state_of_an_older_distribution(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(OLDER, STATE))
    message = store.types[STATE](header(1.0), NAMES, point([0.3, 0.4]), point([7.0, 7.0]), point([0.0, 0.0]))
    path = bag(tmp_path / "bag.mcap", [(1.0, "/arm_controller/state", STATE, message)], store, definition_text(OLDER))
    assert at(read_recording(path), [1.0]) == [[0.3, 0.4]]


def test_commands_of_another_robot_are_not_of_this_one(tmp_path: Path) -> None:
    kind = "sensor_msgs/msg/JointState"
    messages = [
        (1.0, "/left/joint_states", kind, joint_state(1.0, [0.1, 0.2])),
        (1.0, "/left/joint_commands", kind, joint_state(1.0, [0.1, 0.2])),
        (1.0, "/right/joint_commands", kind, joint_state(1.0, [0.3, 0.4])),
        (1.0, "/joint_commands", kind, joint_state(1.0, [0.5, 0.6])),
    ]
    recording = read_recording(bag(tmp_path / "bag.mcap", messages))
    assert [track.topic for track in recording.commands] == ["/joint_commands", "/left/joint_commands"]


def definition_text(own: str) -> str:
    """The definition as a recorder writes it: that of the type, and of each that it uses."""
    parts = [own]
    for name in ("std_msgs/msg/Header", "trajectory_msgs/msg/JointTrajectoryPoint"):
        parts.append(f"MSG: {name.replace('/msg/', '/')}\n{definition(name)[0].split('=' * 80)[0]}")
    for name in ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"):
        parts.append(f"MSG: {name.replace('/msg/', '/')}\n{definition(name)[0]}")
    return ("=" * 80 + "\n").join(parts)


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
    """Names of the last message are remembered: others, in another order, or twice the same one, are looked at again."""
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

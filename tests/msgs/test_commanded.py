"""Commanded joints in bags: joint states of their own, trajectories, and the state of a controller."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from msgs import bag_forms as forms
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from modcal_core.measurements.recording import Recording, commanded_at
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

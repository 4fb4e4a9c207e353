"""A recording to a bag: the way back from arrays to messages, on the contract's topics."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.errors import BadRecording
from modcal_core.measurements.recording import Recording
from modcal_msgs_py.bag_files import appearing
from modcal_msgs_py.mcap_write import BagWriter
from modcal_msgs_py.topics import JOINT_STATES, NOTES, READINGS, ROBOT_DESCRIPTION, TEMPERATURE, TYPES
from modcal_msgs_py.types import message_class

_TOPIC_OF = {kind: role for role, kind in READINGS.items()}
_NO_NUMBERS = np.empty(0)
_MANY = 500  # messages between two words of how far it is


def write_recording(recording: Recording, folder: Path, heard: Callable[[float], None] = lambda share: None) -> None:
    """Write joint states, readings, temperatures, the robot description and notes of a recording as a bag.

    The folder appears at once and whole, or not at all. heard: is told the share that is written. Raises BadRecording
    when the folder exists already, or cannot be written.
    """
    with appearing(folder) as stage:
        try:
            _write(recording, stage, heard)
        except BadRecording as error:  # of a disk that refuses; nothing is left for a repair
            raise BadRecording(str(folder), error.limit, "make room on the disk, or write elsewhere") from error


def _write(recording: Recording, folder: Path, heard: Callable[[float], None]) -> None:
    count = sum(len(t.stamps) for tracks in (recording.joints, recording.readings, recording.signals) for t in tracks)
    stamped = []
    for message in _messages(recording):
        stamped.append(message)
        if len(stamped) % _MANY == 0:
            heard(0.5 * len(stamped) / count)
    stamped.sort(key=lambda m: m[0])
    start = stamped[0][0] if stamped else 0
    with BagWriter(folder) as bag:
        String = message_class("std_msgs/msg/String")
        if recording.robot_description is not None:
            bag.write(
                f"/{ROBOT_DESCRIPTION}", TYPES[ROBOT_DESCRIPTION], String(data=recording.robot_description), start
            )
        for note in recording.warnings:
            bag.write(f"/{NOTES}", TYPES[NOTES], String(data=note), start)
        for i, (stamp, role, message) in enumerate(stamped):
            bag.write(f"/{role}", TYPES[role], message, stamp)
            if i % _MANY == 0:
                heard(0.5 * (1.0 + i / len(stamped)))


def _messages(recording: Recording) -> Iterator[tuple[int, str, Any]]:
    JointState, Temperature = message_class(TYPES[JOINT_STATES]), message_class(TYPES[TEMPERATURE])
    for track in recording.joints:
        for i, stamp in enumerate(track.stamps):
            ns = _ns(stamp)
            yield (
                ns,
                JOINT_STATES,
                JointState(
                    header=_header(ns, ""),
                    name=list(track.names),
                    position=np.ascontiguousarray(track.position[i]),
                    velocity=_known(track.velocity[i]),
                    effort=_known(track.effort[i]),
                ),
            )
    for reading in recording.readings:
        role = _TOPIC_OF[reading.kind]
        make = _MAKERS[TYPES[role]]
        for stamp, values in zip(reading.stamps, reading.values, strict=True):
            ns = _ns(stamp)
            yield ns, role, make(_header(ns, reading.frame), [float(v) for v in values])
    for signal in recording.signals:
        role, _, frame = signal.name.partition(":")
        if role == TEMPERATURE:
            for stamp, value in zip(signal.stamps, signal.values[:, 0], strict=True):
                ns = _ns(stamp)
                yield ns, TEMPERATURE, Temperature(header=_header(ns, frame), temperature=float(value), variance=0.0)


def _ns(stamp: float) -> int:
    """Nanoseconds of a stamp in seconds, which as a float is exact to a fifth of a microsecond."""
    return round(stamp * 1e6) * 1000


def _header(ns: int, frame: str) -> Any:
    Time = message_class("builtin_interfaces/msg/Time")
    return message_class("std_msgs/msg/Header")(stamp=Time(sec=ns // 10**9, nanosec=ns % 10**9), frame_id=frame)


def _known(row: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(row) if np.isfinite(row).all() else _NO_NUMBERS


def _point(values: list[float]) -> Any:
    return message_class("geometry_msgs/msg/Point")(x=values[0], y=values[1], z=values[2])


def _pose_stamped(header: Any, values: list[float]) -> Any:
    x, y, z, w = values[3:]
    orientation = message_class("geometry_msgs/msg/Quaternion")(x=x, y=y, z=z, w=w)
    pose = message_class("geometry_msgs/msg/Pose")(position=_point(values), orientation=orientation)
    return message_class("geometry_msgs/msg/PoseStamped")(header=header, pose=pose)


def _point_stamped(header: Any, values: list[float]) -> Any:
    return message_class("geometry_msgs/msg/PointStamped")(header=header, point=_point(values))


def _vector_stamped(header: Any, values: list[float]) -> Any:
    vector = message_class("geometry_msgs/msg/Vector3")(x=values[0], y=values[1], z=values[2])
    return message_class("geometry_msgs/msg/Vector3Stamped")(header=header, vector=vector)


def _range(header: Any, values: list[float]) -> Any:
    make = message_class("sensor_msgs/msg/Range")
    # of a gauge nothing is known but what it reads; the message has no type for one
    return make(
        header=header, radiation_type=make.INFRARED, field_of_view=0.0, min_range=0.0, max_range=0.0, range=values[0],
        variance=0.0,
    )  # fmt: skip


_MAKERS = {
    "geometry_msgs/msg/PoseStamped": _pose_stamped,
    "geometry_msgs/msg/PointStamped": _point_stamped,
    "geometry_msgs/msg/Vector3Stamped": _vector_stamped,
    "sensor_msgs/msg/Range": _range,
}

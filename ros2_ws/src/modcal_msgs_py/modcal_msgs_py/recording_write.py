"""A recording to a bag: the way back from arrays to messages, on the contract's topics."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.errors import BadRecording
from modcal_core.measurements import PART, POINT, POSE, JointTrack, ReadingTrack, Recording
from modcal_msgs_py.bag_files import appearing
from modcal_msgs_py.layout import message_class
from modcal_msgs_py.mcap_write import BagWriter
from modcal_msgs_py.topics import JOINT_STATES, NOTES, READINGS, ROBOT_DESCRIPTION, TEMPERATURE, TYPES

_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
_SIGNAL = "std_msgs/msg/Float64"
_TOPIC_OF = {kind: role for role, kind in READINGS.items()}
_NO_NUMBERS = np.empty(0)
_MANY = 500  # messages between two words of how far it is


def write_recording(
    recording: Recording,
    folder: Path,
    heard: Callable[[float], None] = lambda share: None,
    commanded: JointTrack | None = None,
) -> None:
    """Write joint states, readings, temperatures, signals, the robot description and notes of a recording as a bag.

    The folder appears at once and whole, or not at all. heard: is told the share that is written. commanded: joint
    positions that were commanded, for a topic of their own. Signals of messages with one number are written.
    Raises BadRecording when the folder exists already, or cannot be written.
    """
    with appearing(folder) as stage:
        try:
            _write(recording, stage, heard, commanded)
        except BadRecording as error:  # of a disk that refuses; nothing is left for a repair
            raise BadRecording(str(folder), error.limit, "make room on the disk, or write elsewhere") from error


def _write(
    recording: Recording, folder: Path, heard: Callable[[float], None], commanded: JointTrack | None = None
) -> None:
    count = sum(len(t.stamps) for tracks in (recording.joints, recording.readings, recording.signals) for t in tracks)
    stamped = []
    for message in _messages(recording, commanded):
        stamped.append(message)
        if len(stamped) % _MANY == 0:
            heard(0.5 * len(stamped) / max(count, len(stamped)))
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
        for i, (stamp, topic, type_name, message) in enumerate(stamped):
            bag.write(topic, type_name, message, stamp)
            if i % _MANY == 0:
                heard(0.5 * (1.0 + i / len(stamped)))


def _messages(recording: Recording, commanded: JointTrack | None) -> Iterator[tuple[int, str, str, Any]]:
    """(time [ns], topic, type, message) of everything."""
    for track in recording.joints:
        yield from _joint_states(track, f"/{JOINT_STATES}")
    for told in (*recording.commands, *(() if commanded is None else (commanded,))):
        yield from _joint_states(told, told.topic)
    for reading in recording.readings:  # a topic has one type
        own = any(r.stated is not None for r in recording.readings if r.kind == reading.kind)
        yield from _reading_messages(reading, own and reading.kind in (POSE, POINT))
    Temperature, Float64 = message_class(TYPES[TEMPERATURE]), message_class(_SIGNAL)
    for signal in recording.signals:
        role, _, name = signal.name.partition(":")
        for stamp, value in zip(signal.stamps, signal.values[:, 0], strict=True):
            ns = _ns(stamp)
            if role == TEMPERATURE:
                message = Temperature(header=_header(ns, name), temperature=float(value), variance=0.0)
                yield ns, f"/{TEMPERATURE}", TYPES[TEMPERATURE], message
            elif PART not in name:  # what was one of many numbers of a message of another type is not made up again
                yield ns, name, _SIGNAL, Float64(data=float(value))


def _joint_states(track: JointTrack, topic: str) -> Iterator[tuple[int, str, str, Any]]:
    JointState = message_class(TYPES[JOINT_STATES])
    for i, stamp in enumerate(track.stamps):
        ns = _ns(stamp)
        message = JointState(
            header=_header(ns, ""),
            name=list(track.names),
            position=np.ascontiguousarray(track.position[i]),
            velocity=_known(track.velocity[i]),
            effort=_known(track.effort[i]),
        )
        yield ns, topic, TYPES[JOINT_STATES], message


def _reading_messages(reading: ReadingTrack, with_covariance: bool) -> Iterator[tuple[int, str, str, Any]]:
    role = _TOPIC_OF[reading.kind]
    for i, (stamp, values) in enumerate(zip(reading.stamps, reading.values, strict=True)):
        ns = _ns(stamp)
        numbers = [float(v) for v in values]
        if not with_covariance:
            yield ns, f"/{role}", TYPES[role], _reading_message(TYPES[role], _header(ns, reading.frame), numbers)
            continue
        own = np.full(2, np.nan) if reading.stated is None else reading.stated[i]
        pose = numbers if reading.kind == POSE else [*numbers, 0.0, 0.0, 0.0, 1.0]
        yield ns, f"/{role}", _WITH_COVARIANCE, _pose_with_covariance(_header(ns, reading.frame), pose, own)


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


def _pose(values: list[float]) -> Any:
    x, y, z, w = values[3:]
    orientation = message_class("geometry_msgs/msg/Quaternion")(x=x, y=y, z=z, w=w)
    return message_class("geometry_msgs/msg/Pose")(position=_point(values), orientation=orientation)


def _pose_with_covariance(header: Any, values: list[float], deviations: np.ndarray) -> Any:
    """deviations: RMS over space of position [m] and angle [rad], spread evenly over the axes; NaN: unknown, zeros."""
    variance = np.repeat(np.where(np.isfinite(deviations), deviations, 0.0) ** 2 / 3.0, 3)
    pose = message_class("geometry_msgs/msg/PoseWithCovariance")(
        pose=_pose(values), covariance=np.diag(variance).ravel()
    )
    return message_class(_WITH_COVARIANCE)(header=header, pose=pose)


def _vector(values: list[float]) -> Any:
    return message_class("geometry_msgs/msg/Vector3")(x=values[0], y=values[1], z=values[2])


def _range(header: Any, values: list[float]) -> Any:
    make = message_class("sensor_msgs/msg/Range")
    # of a gauge nothing is known but what it reads; the message has no type for one
    unknown = dict.fromkeys(("field_of_view", "min_range", "max_range", "variance"), 0.0)
    return make(header=header, radiation_type=make.INFRARED, range=values[0], **unknown)


_STAMPED: dict[str, tuple[str, Callable[[list[float]], Any]]] = {
    "geometry_msgs/msg/PoseStamped": ("pose", _pose),
    "geometry_msgs/msg/PointStamped": ("point", _point),
    "geometry_msgs/msg/Vector3Stamped": ("vector", _vector),
}


def _reading_message(type_name: str, header: Any, values: list[float]) -> Any:
    if type_name not in _STAMPED:
        return _range(header, values)
    name, make = _STAMPED[type_name]
    return message_class(type_name)(header=header, **{name: make(values)})

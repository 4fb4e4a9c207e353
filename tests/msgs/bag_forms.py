"""Bags as others write them: by rosbags, in every storage and packing, with the topics and messages of ordinary cells."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mcap.writer
import numpy as np
from cli.recordings import stations
from rosbags.interfaces import Qos
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import Recording
from modcal_msgs_py.layout import definition, jazzy, message_class

Message = tuple[str, str, Any, int]  # topic, type, message, time of reception [ns]
JOINT_STATE, STRING = "sensor_msgs/msg/JointState", "std_msgs/msg/String"
POSE, POINT = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PointStamped"
WITH_COVARIANCE, TRANSFORM = "geometry_msgs/msg/PoseWithCovarianceStamped", "geometry_msgs/msg/TransformStamped"
ODOMETRY, TF = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"


@dataclass(frozen=True)
class Cell:
    """What a cell shows at each station: stamps [ns], joint positions (n, 6) and poses of the tool (n, 7)."""

    stamps: list[int]
    names: tuple[str, ...]
    q: Array
    poses: Array
    urdf: str


def cell(count: int = 40) -> Cell:
    """The UR10 of MuJoCo."""
    made: Recording = stations(count)
    track = made.joints[0]
    ns = [round(t * 1e9) for t in track.stamps]
    return Cell(ns, track.names, track.position, made.readings[0].values, made.robot_description or "")


def header(ns: int, frame: str = "") -> Any:
    stamp = message_class("builtin_interfaces/msg/Time")(sec=ns // 10**9, nanosec=ns % 10**9)
    return message_class("std_msgs/msg/Header")(stamp=stamp, frame_id=frame)


def joint_state(ns: int, names: Sequence[str], q: Sequence[float] | Array) -> Any:
    none = np.empty(0)
    return message_class(JOINT_STATE)(header(ns), list(names), np.array(q, dtype=float), none, none)


def _pose(values: Array) -> Any:
    point, quaternion = message_class("geometry_msgs/msg/Point"), message_class("geometry_msgs/msg/Quaternion")
    return message_class("geometry_msgs/msg/Pose")(point(*values[:3]), quaternion(*values[3:]))


def _transform(values: Array) -> Any:
    vector, quaternion = message_class("geometry_msgs/msg/Vector3"), message_class("geometry_msgs/msg/Quaternion")
    return message_class("geometry_msgs/msg/Transform")(vector(*values[:3]), quaternion(*values[3:]))


def reading(kind: str, ns: int, values: Array, frame: str = "tracker", covariance: Array | None = None) -> Any:
    """A reading of a pose as a message of this type."""
    if kind == POINT:
        return message_class(POINT)(header(ns, frame), message_class("geometry_msgs/msg/Point")(*values[:3]))
    if kind == POSE:
        return message_class(POSE)(header(ns, frame), _pose(values))
    if kind == TRANSFORM:
        return message_class(TRANSFORM)(header(ns, frame), "tool", _transform(values))
    if kind == TF:
        return message_class(TF)([reading(TRANSFORM, ns, values, frame)])
    covariance = np.zeros(36) if covariance is None else covariance
    posed = message_class("geometry_msgs/msg/PoseWithCovariance")(_pose(values), covariance)
    if kind == WITH_COVARIANCE:
        return message_class(WITH_COVARIANCE)(header(ns, frame), posed)
    vector = message_class("geometry_msgs/msg/Vector3")
    twist = message_class("geometry_msgs/msg/Twist")(vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0))
    moving = message_class("geometry_msgs/msg/TwistWithCovariance")(twist, np.zeros(36))
    return message_class(ODOMETRY)(header(ns, frame), "tool", posed, moving)


def joints(c: Cell, topic: str = "/joint_states") -> list[Message]:
    return [(topic, JOINT_STATE, joint_state(ns, c.names, q), ns) for ns, q in zip(c.stamps, c.q, strict=True)]


def readings(
    c: Cell, topic: str = "/tracker/pose", kind: str = POSE, change: Callable[[Array], Array] | None = None, **more: Any
) -> list[Message]:
    """The tool's poses on this topic. change: of all of them, (n, 4, 4)."""
    poses = c.poses if change is None else se3.to_pose(change(se3.from_pose(c.poses)))
    return [(topic, kind, reading(kind, ns, pose, **more), ns) for ns, pose in zip(c.stamps, poses, strict=True)]


def described(c: Cell, topic: str = "/robot_description") -> list[Message]:
    return [(topic, STRING, message_class(STRING)(c.urdf), c.stamps[0])]


def text(topic: str, data: str, ns: int) -> Message:
    return topic, STRING, message_class(STRING)(data), ns


def write(
    folder: Path,
    messages: Sequence[Message],
    storage: StoragePlugin = StoragePlugin.MCAP,
    packed: CompressionMode = CompressionMode.NONE,
    offered: Mapping[str, Qos] | None = None,
) -> Path:
    """A bag of these messages, as rosbags writes it. offered: QoS by topic."""
    with_writer = Writer(folder, version=9, storage_plugin=storage)
    if packed != CompressionMode.NONE:
        with_writer.set_compression(packed, CompressionFormat.ZSTD)
    with with_writer as writer:
        known: dict[tuple[str, str], Any] = {}
        for topic, kind, message, ns in sorted(messages, key=lambda m: m[3]):
            if (topic, kind) not in known:
                qos = [offered[topic]] if offered else []
                known[topic, kind] = writer.add_connection(topic, kind, typestore=jazzy(), offered_qos_profiles=qos)
            data = message if isinstance(message, bytes) else jazzy().serialize_cdr(message, kind)
            writer.write(known[topic, kind], ns, data)
    return folder


def mcap_file(
    path: Path,
    messages: Sequence[Message],
    definitions: Mapping[str, tuple[str, str]] | None = None,
    store: Any = None,
    little_endian: bool = True,
    **how: Any,
) -> Path:
    """A bare MCAP file of these messages in their order, some of them bytes.

    definitions: encoding and text by type, where they are not those of Jazzy. store: of types. how: of the writer.
    """
    with path.open("wb") as stream:
        writer = mcap.writer.Writer(stream, **how)
        writer.start("ros2")
        channels: dict[tuple[str, str], int] = {}
        for topic, kind, message, ns in messages:
            if (topic, kind) not in channels:
                encoding, text = (definitions or {}).get(kind) or ("ros2msg", definition(kind)[0])
                schema = writer.register_schema(kind, encoding, text.encode())
                channels[topic, kind] = writer.register_channel(topic, "cdr", schema)
            data = message
            if not isinstance(message, bytes):
                data = bytes((store or jazzy()).serialize_cdr(message, kind, little_endian=little_endian))
            writer.add_message(channels[topic, kind], ns, data, ns)
        writer.finish()
    return path

"""What a topic is for, by the name the contract gives it.

    [project.entry-points."modcal.topics"]
    motor_temperatures = "my_package.motor_temperatures:TOPIC"

names an :class:`AddedTopic`. From then on every bag is read with it.

A topic that is found by its type is never one that looks as if it had been computed from the joints or commanded: such
readings agree with the model because they came out of it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from typing import Any, TypeAlias

import numpy as np

from modcal_core.errors import BadRecording, BadTable
from modcal_core.geometry import so3
from modcal_core.measurements import Listed, added
from modcal_core.measurements.kinds import kinds
from modcal_msgs_py.track_rows import JOINT_STATE, STATE_OF_CONTROLLER, TRAJECTORY

GROUP = "modcal.topics"


@dataclass(frozen=True)
class Signal:
    """A number that an error may depend on, by the driver's name: ``temperature:LINK`` [°C], or one of your own."""

    name: str
    value: float


@dataclass(frozen=True)
class Reading:
    """What an instrument read. kind: one of measurements/kinds; values: as many numbers as it has [m, unit length]."""

    kind: str
    frame: str
    values: Sequence[float]


@dataclass(frozen=True)
class Joints:
    """Where the joints are [rad or m], and, where known, their velocities [per s] and efforts [N m or N]."""

    name: Sequence[str]
    position: Sequence[float]
    velocity: Sequence[float] = ()
    effort: Sequence[float] = ()


Said: TypeAlias = Signal | Reading | Joints


@dataclass(frozen=True)
class AddedTopic:
    """One topic of a package.

    topic: its name, or the end of it behind a namespace. message: its type, such as ``my_msgs/msg/Motors``; the bag
    says how it is laid out. take: what one message says; its attributes are those of rclpy. Its stamp is that of its
    header, or, where it has none, the time it was received.
    """

    topic: str
    message: str
    take: Callable[[Any], Iterable[Said]]


# --- robot_calibration's captures: each message is a station, with the joints and what sensors saw of one target

_LEAST = 3  # features that show a pose


def _captured(message: Any) -> Iterator[Said]:
    """The joints, and the target in each camera: a pose where the arm says where the features are on the target, a
    point where there is one.
    """
    state = message.joint_states
    yield Joints(state.name, state.position, state.velocity, state.effort)
    seen = [
        (_is_camera(one), np.array([(f.point.x, f.point.y, f.point.z) for f in one.features]), one.features)
        for one in message.observations
        if len(one.features)
    ]
    for camera, points, features in seen:
        layout = next((p for is_camera, p, _ in seen if not is_camera and len(p) == len(points)), None)
        if not camera:
            continue
        frame = str(features[0].header.frame_id)
        if len(points) == 1:
            yield Reading("point", frame, points[0])
        elif layout is not None and len(points) >= _LEAST:
            R = so3.nearest_rotation((points - points.mean(axis=0)).T @ (layout - layout.mean(axis=0)))
            yield Reading("pose", frame, [*(points - layout @ R.T).mean(axis=0), *so3.to_quaternion(R)])


def _is_camera(observation: Any) -> bool:
    """Whether an observation says what camera it was seen by."""
    info = observation.ext_camera_info.camera_info
    return float(next(iter(getattr(info, "k", getattr(info, "K", ()))), 0.0)) > 0.0


_CAPTURES = AddedTopic("calibration_data", "robot_calibration_msgs/msg/CalibrationData", _captured)


@cache
def added_topics() -> dict[str, AddedTopic]:
    """robot_calibration's captures, and the topics of installed packages, by name. Raises BadTable for what is none, or
    that two packages claim.
    """
    out = {_CAPTURES.topic: _CAPTURES}
    for offender, named in added(GROUP):
        if not isinstance(named, AddedTopic):
            raise BadTable(offender, f"names a {type(named).__name__}", "name an AddedTopic")
        topic = named.topic.strip("/")
        if topic in out:
            raise BadTable(offender, f"topic {topic} is already used", "choose another")
        out[topic] = named
    return out


JOINT_STATES = "joint_states"
JOINT_COMMANDS = "joint_commands"
CONTROLLER_STATE = "controller_state"
COMMANDS = (JOINT_COMMANDS, CONTROLLER_STATE)  # the first is preferred
ROBOT_DESCRIPTION = "robot_description"
TEMPERATURE = "temperature"
WRENCH = "wrench"
NOTES = "modcal/notes"

READINGS = {kind.topic: kind.name for kind in kinds().values()}
TYPES = {
    JOINT_STATES: JOINT_STATE,
    ROBOT_DESCRIPTION: "std_msgs/msg/String",
    JOINT_COMMANDS: JOINT_STATE,
    CONTROLLER_STATE: STATE_OF_CONTROLLER,
    TEMPERATURE: "sensor_msgs/msg/Temperature",
    WRENCH: "geometry_msgs/msg/WrenchStamped",
    NOTES: "std_msgs/msg/String",
    **{kind.topic: kind.message for kind in kinds().values()},
}
ADDED = added_topics()
POSES = (  # types of messages that hold a pose
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Odometry",
)
TRANSFORMS = "tf2_msgs/msg/TFMessage"
TF, TF_STATIC = "/tf", "/tf_static"
LATCHED = (ROBOT_DESCRIPTION, NOTES)

for _topic, _added in ADDED.items():
    if _topic in TYPES:
        raise BadTable(f"topic {_topic} of {GROUP}", "is used by modcal itself", "choose another name")
    TYPES[_topic] = _added.message


def accepted(role: str) -> tuple[str, ...]:
    """The types of messages that a role may have; where positions are asked for, a pose will do.

    Commands are joint states of their own, or trajectories.
    """
    own = TYPES[role]
    if role == JOINT_COMMANDS:
        return (own, TRAJECTORY)
    if own == POSES[0]:
        return POSES
    return (own, *POSES) if own == "geometry_msgs/msg/PointStamped" else (own,)


_ACCEPTED = {role: accepted(role) for role in TYPES}


@lru_cache(maxsize=256)  # of a few topics, whose every message is asked for
def role_of(topic: str, type_name: str) -> str | None:
    """The contract's name for a topic, in whatever namespace it stands; None for a topic of no known role.

    The state of a controller of trajectories is told by its type, whatever its name.
    """
    for role, types in _ACCEPTED.items():
        if (topic == f"/{role}" or topic.endswith(f"/{role}")) and type_name in types:
            return role
    return CONTROLLER_STATE if type_name == STATE_OF_CONTROLLER else None


def preferred(topics: set[str], role: str) -> set[str]:
    """The topic at the contract's own name, where it is among these; else all of them."""
    return {f"/{role}"} if f"/{role}" in topics else topics


# --- Which topic of a bag plays which role: as stated, by the contract's names, or, where only one can, by its type

_POSE, _POINT = "tracker/pose", "tracker/point"
# Parts of names of what was commanded, or computed from the joints
_NOT_MEASURED = re.compile(
    r"command|desired|target_|goal|setpoint|reference|expected|corrected|predicted|broadcaster|tcp|cartesian|odom|initial"
    r"|(^|[/_])(ee|eef|fk|flange|tool0|plan|path)([/_]|$)"
)
_SHOWN = 12  # topics in a refusal


@dataclass(frozen=True)
class Topics:
    """What a person says of the topics of a bag.

    stated: (role, topic) pairs. ignored: topics that are left out. tf: (parent, child) frames of /tf that are the
    reading of the tracker.
    """

    stated: tuple[tuple[str, str], ...] = ()
    ignored: tuple[str, ...] = ()
    tf: tuple[str, str] | None = None

    @classmethod
    def of(cls, topics: Iterable[str] = (), ignored: Iterable[str] = (), tf: str | None = None) -> Topics:
        """From ROLE=NAME, names and PARENT:CHILD, as options and cell files give them. Raises BadTable."""
        stated = []
        for text in topics:
            role, equals, name = text.partition("=")
            role, name = role.strip().strip("/"), name.strip()
            if not equals or not name.strip("/"):
                raise BadTable(f"topic {text}", "is not ROLE=NAME", "write it as tracker/pose=/vrpn/tool/pose")
            if role not in TYPES:
                raise BadTable(f"topic {text}", f"{role} is not a role", f"roles are {', '.join(TYPES)}")
            stated.append((role, _absolute(name)))
        pair = None
        if tf is not None:
            parent, colon, child = (part.strip().strip("/") for part in tf.partition(":"))
            if not colon or not parent or not child or parent == child:
                raise BadTable(f"tf {tf}", "is not PARENT:CHILD", "write it as tracker:tool")
            pair = parent, child
        return cls(tuple(stated), tuple(_absolute(name) for name in ignored), pair)

    def over(self, other: Topics) -> Topics:
        """These statements, and the other's of roles that these say nothing of."""
        mine = {role for role, _ in self.stated}
        rest = tuple((role, name) for role, name in other.stated if role not in mine)
        return Topics((*self.stated, *rest), (*self.ignored, *other.ignored), self.tf or other.tf)


@dataclass(frozen=True)
class Roles:
    """The role of every topic of a bag that has one. left_out: topics that are not read at all.

    by_type: topics whose role was found by their type. notes: what a person should know of that.
    """

    of: dict[tuple[str, str], str] = field(default_factory=dict)
    left_out: frozenset[str] = frozenset()
    by_type: frozenset[str] = frozenset()
    notes: tuple[str, ...] = ()
    tf: tuple[str, str] | None = None
    listed: tuple[Listed, ...] = ()

    def role(self, topic: str, type_name: str) -> str | None:
        """The contract's name for a topic, None for one of no known role."""
        return self.of.get((topic, type_name))


def resolve(listed: Sequence[Listed], topics: Topics, source: str) -> Roles:
    """The roles of a bag's topics. Raises BadRecording where a stated topic is not there or of another type."""
    here: dict[str, list[Listed]] = {}
    for one in listed:
        here.setdefault(one.topic, []).append(one)
    found: dict[tuple[str, str], str] = {}
    for role, name in topics.stated:
        if name not in here:
            raise BadRecording(f"topic {name}", f"is not in {source}", f"there are {_shown(listed)}")
        fitting = [one for one in here[name] if one.type_name in accepted(role)]
        if not fitting:
            said = f"is a {here[name][0].type_name}; {role} is {' or '.join(accepted(role))}"
            raise BadRecording(f"topic {name}", said, f"there are {_shown(listed)}")
        found.update({(one.topic, one.type_name): role for one in fitting})
    ignored = set(topics.ignored)
    if topics.tf is not None and not any(one.type_name == TRANSFORMS for one in listed):
        raise BadRecording(f"tf {':'.join(topics.tf)}", f"there is no {TF} in {source}", f"there are {_shown(listed)}")
    taken = {role for role, _ in topics.stated} | ({_POSE} if topics.tf is not None else set())
    left_out = set(ignored)
    for one in listed:
        if (one.topic, one.type_name) in found or one.topic in ignored:
            continue
        own = role_of(one.topic, one.type_name)
        if own is not None and own in taken:
            left_out.add(one.topic)  # of another robot, or another tracker
        elif own is not None:
            found[one.topic, one.type_name] = own
    notes = [f"{name} is not in {source}: nothing to ignore." for name in topics.ignored if name not in here]
    by_type = _by_type(listed, found, left_out, topics.tf is not None)
    for one, role in by_type.items():
        found[one.topic, one.type_name] = role
        notes.append(f"{one.topic} ({_short(one.type_name)}) is used as {role}: the only possible topic.")
    return Roles(
        found, frozenset(left_out), frozenset(one.topic for one in by_type), tuple(notes), topics.tf, tuple(listed)
    )


def could_be(topic: str, type_name: str) -> tuple[str, ...]:
    """Roles that a topic could play, by its type alone."""
    if type_name == TRANSFORMS:
        return ("tf",) if topic in (TF, TF_STATIC) else ()
    if type_name in (TYPES[ROBOT_DESCRIPTION],):
        return (ROBOT_DESCRIPTION,) if "description" in topic else ()
    return tuple(role for role in TYPES if type_name in accepted(role))


def _by_type(
    listed: Sequence[Listed], found: dict[tuple[str, str], str], left_out: set[str], transforms: bool
) -> dict[Listed, str]:
    """Joint states and positions of the tracker that nobody named, where exactly one topic can be them."""
    out: dict[Listed, str] = {}
    free = [
        one
        for one in listed
        if (one.topic, one.type_name) not in found and one.topic not in left_out and one.count != 0
        and not _NOT_MEASURED.search(one.topic.lower())
    ]  # fmt: skip
    if JOINT_STATES not in found.values():
        joints = [one for one in free if one.type_name == TYPES[JOINT_STATES]]
        out.update({joints[0]: JOINT_STATES} if len(joints) == 1 else {})
    if not transforms and not set(found.values()) & set(READINGS):
        seen = [one for one in free if one.type_name in (*POSES, TYPES[_POINT])]
        if len(seen) == 1:
            out[seen[0]] = _POINT if seen[0].type_name == TYPES[_POINT] else _POSE
    return out


def _absolute(name: str) -> str:
    return "/" + name.strip().strip("/")


def _short(type_name: str) -> str:
    return type_name.rpartition("/")[2]


def _shown(listed: Sequence[Listed]) -> str:
    """What is there, those first that could play a role."""
    order = sorted(listed, key=lambda one: (not could_be(one.topic, one.type_name), one.topic))
    names = [f"{one.topic} ({_short(one.type_name)})" for one in order[:_SHOWN]]
    return ", ".join([*names, *([f"and {len(order) - _SHOWN} more"] if len(order) > _SHOWN else [])]) or "no topics"

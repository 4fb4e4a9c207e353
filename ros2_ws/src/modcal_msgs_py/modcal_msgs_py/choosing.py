"""Which topic of a bag plays which role: as stated, by the contract's names, or, where only one can, by its type.

A topic that is found by its type is never one that looks as if it had been computed from the joints or commanded: such
readings agree with the model because they came out of it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from modcal_core.errors import BadRecording, BadTable
from modcal_core.measurements.recording import Listed
from modcal_msgs_py.topics import (
    JOINT_STATES,
    POSES,
    READINGS,
    ROBOT_DESCRIPTION,
    TF,
    TF_STATIC,
    TRANSFORMS,
    TYPES,
    accepted,
    role_of,
)

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

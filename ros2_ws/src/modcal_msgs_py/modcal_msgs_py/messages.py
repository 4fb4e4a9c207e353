"""Messages to a recording: one path for a bag and for the wire.

Messages come as objects, of rclpy or decoded, or many of one layout at once; they are read by the same paths.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.errors import BadRecording, BadTable, ModcalError
from modcal_core.geometry import Array
from modcal_core.measurements import PART, JointTrack, Listed, ReadingTrack, Recording, SignalTrack, elsewhen
from modcal_core.measurements.kinds import kinds
from modcal_msgs_py.layout import MessageRows, Messages, OneMessage
from modcal_msgs_py.readings import Transforms, stated_in, values_of
from modcal_msgs_py.topics import (
    ADDED,
    COMMANDS,
    JOINT_STATES,
    NOTES,
    READINGS,
    ROBOT_DESCRIPTION,
    TEMPERATURE,
    TF_STATIC,
    TRANSFORMS,
    Joints,
    Reading,
    Roles,
    Said,
    Signal,
    could_be,
    preferred,
    role_of,
)
from modcal_msgs_py.track_rows import Commands, TrackRows

_MAX_DESCRIPTIONS = 8  # different ones that are kept of a topic


class Descriptions:
    """URDF texts by the topic that brought them."""

    def __init__(self) -> None:
        self._texts: dict[str, list[str]] = {}

    def add(self, topic: str, text: str) -> None:
        """Keep a robot description, if it is another one than those before."""
        kept = self._texts.setdefault(topic, [])
        if text not in kept and len(kept) < _MAX_DESCRIPTIONS:
            kept.append(text)

    def chosen(self, joints: tuple[JointTrack, ...]) -> tuple[str | None, list[str]]:
        """The description that has most of the recorded joints, the earlier of equals; and what to say of others."""
        topics = sorted(preferred(set(self._texts), ROBOT_DESCRIPTION))
        texts = [(topic, text) for topic in topics for text in self._texts[topic]]
        if not texts:
            return None, []
        names = {name for track in joints for name in track.names}

        def known(text: str) -> int:
            return sum(f'"{name}"' in text or f"'{name}'" in text for name in names)

        topic, chosen = max(texts, key=lambda pair: known(pair[1]))  # the first of equals
        others = len(self._texts[topic]) - 1
        said = f"{topic} was published with {others + 1} different contents: the one with most recorded joints was used"
        return chosen, [f"{said}."] if others else []


def is_link(frame: str, description: str) -> bool:
    """Whether a robot description has a link of this name."""
    frame = frame.strip("/")
    return bool(frame) and re.search(rf"<link\b[^>]*\bname\s*=\s*[\"']{re.escape(frame)}[\"']", description) is not None


_MAX_NAMED = 4  # instruments; a cell of many anchors would fill the line


def began(recording: Recording) -> float | None:
    """The first stamp of joint states and readings [s], but for those of another time; None where there are none."""
    tracks: tuple[JointTrack | ReadingTrack, ...] = (*recording.joints, *recording.readings)
    stamps = [t.stamps[~elsewhen(t.stamps)] for t in tracks]
    return min((float(s.min()) for s in stamps if len(s)), default=None)


def digest(bag: Path) -> str:
    """SHA-256 of a bag: of its file, or of what ``sha256sum`` prints of a folder's files in order of their names."""
    if bag.is_file():
        return _digest_of(bag)
    lines = (f"{_digest_of(file)}  {file.name}\n" for file in sorted(bag.iterdir()) if file.is_file())
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _digest_of(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def instruments(recording: Recording, frames: set[str]) -> str | None:
    """Kind, topic and frame of the readings in these frames, all of them where none are given; None: no readings."""
    tracks = [t for t in recording.readings if not frames or t.frame in frames]
    named = list(dict.fromkeys(f"{t.kind} on {t.topic} in {t.frame}" for t in tracks))
    if len(named) > _MAX_NAMED:
        named = [*named[:_MAX_NAMED], f"{len(named) - _MAX_NAMED} more"]
    return "; ".join(named) or None


NO_POSITIONS = "it holds names without positions"


class RecordingBuilder:
    """Collects messages, in any order and at any rate, into a :class:`Recording`.

    A topic that stands at the contract's own name is preferred to one of the same role in a namespace.
    """

    def __init__(self, source: str = "recording", roles: Roles | None = None) -> None:
        """Start with nothing; ``source`` names the recording in messages to people.

        roles: of the topics; None: those of the contract's names.
        """
        self._source, self._roles = source, roles
        self._transforms = None if roles is None or roles.tf is None else Transforms(*roles.tf)
        self._joints = defaultdict[tuple[str, tuple[str, ...]], TrackRows](TrackRows)  # by topic and names
        self._readings = defaultdict[tuple[str, str, str], TrackRows](TrackRows)  # by topic, kind and frame
        self._signals = defaultdict[tuple[str, str], TrackRows](TrackRows)  # by topic and name
        self._commands = Commands()
        self._commanded: dict[str, int] = {}  # rank of each topic of commands
        self._descriptions = Descriptions()
        self._notes: list[str] = []
        self._unstamped: dict[str, int] = {}
        self._lost: dict[tuple[str, str], int] = {}

    def role(self, topic: str, type_name: str) -> str | None:
        """What a topic is used as."""
        return role_of(topic, type_name) if self._roles is None else self._roles.role(topic, type_name)

    def reads(self, topic: str, type_name: str) -> bool:
        """Whether messages of this topic are wanted at all."""
        if type_name == TRANSFORMS:
            return self._transforms is not None
        return self._roles is None or topic not in self._roles.left_out

    def lose(self, topic: str, why: str, count: int = 1) -> None:
        """Count messages that were left out."""
        self._lost[topic, why] = self._lost.get((topic, why), 0) + count

    def add(self, topic: str, type_name: str, message: Any, received: float = math.nan) -> None:
        """Take one message, received at this time [s]. Raises BadRecording for one that contradicts itself."""
        self.take(topic, type_name, OneMessage(message), np.array([received]))

    def take(self, topic: str, type_name: str, said: Messages, received: Array) -> None:
        """Take messages received at these times (n,) [s]; of a package's topics one at a time. Raises BadRecording."""
        role = self.role(topic, type_name)
        stamps, frame = self._stamps(topic, said, received), said.text("header/frame_id")
        if type_name == TRANSFORMS:
            self._take_transforms(topic, said, received)
        elif role == JOINT_STATES:
            columns = [said.column(path) for path in ("position", "velocity", "effort")]
            self._take_joints(topic, said.texts("name"), stamps, received, columns)
        elif role in COMMANDS:
            self._commanded.setdefault(topic, _rank(topic, role))
            self._commands.take(topic, type_name, said, stamps, received)
        elif role in READINGS:
            rows = self._readings[topic, READINGS[role], frame]
            values, stated = values_of(READINGS[role], type_name, said), stated_in(type_name, len(stamps), said)
            rows.extend(stamps=stamps, received=received, values=values, stated=stated)
        elif role == ROBOT_DESCRIPTION:
            self._descriptions.add(topic, said.text("data"))
        elif role == NOTES:
            self._notes += [said.text("data")] * len(received)
        elif role == TEMPERATURE:
            self._take_signal(topic, f"temperature:{frame}", stamps, received, said.column("temperature")[:, 0])
        elif role in ADDED and isinstance(said, OneMessage):
            for one in ADDED[role].take(said.message):
                self._take_said(topic, one, stamps, received)
        elif isinstance(said, MessageRows):
            numbers = list(said.signals())
            for path, numbers_of in numbers:
                part = f"{PART}{path}" if len(numbers) > 1 else ""
                self._take_signal(topic, f"signal:{topic}{part}", stamps, received, numbers_of)

    @property
    def joint_states(self) -> int:
        """How many joint states of one publisher there are, of that with most."""
        return max((len(rows) for rows in self._joints.values()), default=0)

    def forget_before(self, received: float) -> None:
        """Forget what was received before this time [s], but for robot descriptions."""
        for tracks in (self._joints, self._readings, self._signals):
            for rows in tracks.values():
                rows.forget_before(received)
        self._commands.forget_before(received)
        if self._transforms is not None:
            self._transforms.forget_before(received)
        self._notes.clear()
        self._unstamped.clear()
        self._lost.clear()

    def recording(self) -> Recording:
        """Everything taken so far."""
        joint_topics = preferred({topic for topic, _ in self._joints}, JOINT_STATES)
        reading_topics = {
            role: preferred({topic for topic, k, _ in self._readings if k == kind}, role)
            for role, kind in READINGS.items()
        }
        chosen = {topic for topics in reading_topics.values() for topic in topics}
        joints = tuple(
            JointTrack(names, topic=topic, **rows.columns())
            for (topic, names), rows in self._joints.items()
            if topic in joint_topics
        )
        description, notes = self._descriptions.chosen(joints)
        warnings = [
            *notes,
            *(
                f"{count} messages on {topic} had no stamp; the time of reception was used."
                for topic, count in self._unstamped.items()
            ),
            *(f"{count} messages on {topic} were left out: {why}." for (topic, why), count in self._lost.items()),
        ]
        by_type = frozenset[str]() if self._roles is None else self._roles.by_type
        found = [] if self._roles is None else list(self._roles.notes)
        readings = []
        for (topic, kind, frame), rows in self._readings.items():
            if topic not in chosen:
                continue
            if topic in by_type and description is not None and is_link(frame, description):
                found = [note for note in found if not note.startswith(f"{topic} ")]
                role = next(role for role, name in READINGS.items() if name == kind)
                warnings.append(
                    f"{topic} is in {frame}, a link of the robot: it looks computed from the joints and is not used; "
                    f"if it was measured, state --topic {role}={topic}."
                )
                continue
            found_in = ReadingTrack(kind, frame, topic=topic, by_type=topic in by_type, **rows.columns())
            said = found_in.stated is not None and bool(np.isfinite(found_in.stated).any())
            readings.append(found_in if said else replace(found_in, stated=None))
        if self._transforms is not None:
            readings.append(self._transforms.track(description))
            warnings += self._transforms.notes
        lost: dict[str, int] = {}
        for (_, why), count in self._lost.items():
            lost[f"messages: {why}"] = lost.get(f"messages: {why}", 0) + count
        return Recording(
            joints=joints,
            readings=tuple(readings),
            signals=tuple(
                SignalTrack(name, columns["stamps"], columns["values"], topic)
                for (topic, name), rows in self._signals.items()
                for columns in [rows.columns()]
            ),
            robot_description=description,
            source=self._source,
            warnings=(*self._notes, *found, *warnings),
            listed=self._listed(),
            lost=tuple(lost.items()),
            commands=tuple(
                track
                for track in self._commands.tracks(lambda topic: self._commanded[topic])
                if _of_robot(track.topic, joint_topics)
            ),
        )

    def _listed(self) -> tuple[Listed, ...]:
        return tuple(
            Listed(
                one.topic,
                one.type_name,
                one.count,
                self.role(one.topic, one.type_name),
                could_be(one.topic, one.type_name),
            )
            for one in (() if self._roles is None else self._roles.listed)
        )

    def _take_joints(
        self, topic: str, names: tuple[str, ...], stamps: Array, received: Array, columns: list[Array]
    ) -> None:
        n, positions = len(names), columns[0].shape[1]
        if positions != n or len(set(names)) != n:
            said = f"{positions} positions for {n} names, {len(set(names))} of them distinct"
            said = NO_POSITIONS if not positions else said
            raise BadRecording(f"{topic} at stamp {stamps[0]:.3f} s", said, "publish one position for every name")
        # a column that was not sent, or not for every joint, is unknown for all of them
        position, velocity, effort = (c if c.shape[1] == n else np.full((len(c), n), np.nan) for c in columns)
        rows = self._joints[topic, names]
        rows.extend(stamps=stamps, received=received, position=position, velocity=velocity, effort=effort)

    def _take_transforms(self, topic: str, said: Messages, received: Array) -> None:
        if self._transforms is None:
            return
        for i in range(said.count("transforms")):
            at = f"transforms[{i}]"
            stamps = _seconds(said, f"{at}/header/stamp")
            paths = [f"translation/{a}" for a in "xyz"] + [f"rotation/{a}" for a in "xyzw"]
            values = np.hstack([said.column(f"{at}/transform/{path}") for path in paths])
            frames = said.text(f"{at}/header/frame_id"), said.text(f"{at}/child_frame_id")
            self._transforms.add(*frames, stamps, received, values, topic == TF_STATIC)

    def _take_said(self, topic: str, said: Said, stamps: Array, received: Array) -> None:
        """Take what a package makes of its own message. Raises BadTable where it makes no sense of it."""
        if isinstance(said, Signal):
            self._take_signal(topic, said.name, stamps, received, np.array([float(said.value)]))
        elif isinstance(said, Joints):
            columns = [np.atleast_2d(np.asarray(c, dtype=float)) for c in (said.position, said.velocity, said.effort)]
            self._take_joints(topic, tuple(said.name), stamps, received, columns)
        elif isinstance(said, Reading) and said.kind in kinds() and len(said.values) == kinds()[said.kind].width:
            values, stated = np.array([[float(x) for x in said.values]]), np.full((1, 2), math.nan)
            rows = self._readings[topic, said.kind, said.frame]
            rows.extend(stamps=stamps, received=received, values=values, stated=stated)
        else:
            raise BadTable(f"topic {topic}", f"its package made {said!r} of one", "yield Signal, Joints or a Reading")

    def _take_signal(self, topic: str, name: str, stamps: Array, received: Array, values: Array) -> None:
        self._signals[topic, name].extend(stamps=stamps, received=received, values=values[:, None])

    def _stamps(self, topic: str, said: Messages, received: Array) -> Array:
        """The stamps of messages (n,) [s], or when they were received where they have none."""
        if not said.has("header/stamp/sec"):
            return received
        stamps = _seconds(said, "header/stamp")
        without = (stamps == 0.0) & np.isfinite(received) & (received != 0.0)  # a table may begin at zero
        if without.any():
            self._unstamped[topic] = self._unstamped.get(topic, 0) + int(without.sum())
        return np.where(without, received, stamps)


def _seconds(said: Messages, path: str) -> Array:
    """Times (n,) [s] at a path."""
    return np.asarray(said.column(f"{path}/sec")[:, 0] + 1e-9 * said.column(f"{path}/nanosec")[:, 0])


def why_left_out(error: ModcalError) -> str:
    """Why a message was refused, without what is of this message alone."""
    return NO_POSITIONS if error.limit == NO_POSITIONS else "names and positions do not go together"


def _of_robot(topic: str, joint_topics: set[str]) -> bool:
    """Whether commands can be those of the joints on these topics: in no namespace, or in theirs."""
    spaces = {name.rpartition("/")[0] for name in joint_topics}
    return topic.count("/") < 2 or not spaces or any(topic.startswith(f"{space}/") for space in spaces)


def _rank(topic: str, role: str) -> int:
    """Which topic of commands is asked first: the contract's own name, then by role."""
    return 2 * COMMANDS.index(role) + (topic != f"/{role}")

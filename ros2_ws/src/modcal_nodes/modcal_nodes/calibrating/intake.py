"""Messages of the cell on their way into the buffer, and through the arm's stream to the supervisor."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import JointState, PointCloud2, Temperature
from std_msgs.msg import String

from modcal_core.calibration import fingerprint
from modcal_core.errors import BadRecording, BadTable, ModcalError
from modcal_core.measurements import DAY, ELSEWHEN, UNUSABLE, Dropped, Recording, Samples, joint_limits, together
from modcal_core.measurements.kinds import kinds
from modcal_core.online import ASKED, BETTER, Policy, SampleStream, Supervisor
from modcal_core.recalibrate import SampleMemory
from modcal_core.robots import Chain, Delta, JointColumns, Mechanism, is_serial_arm, read_chain
from modcal_msgs_py import (
    JOINT_COMMANDS,
    JOINT_STATES,
    TYPES,
    Commands,
    OneMessage,
    RecordingBuilder,
    accepted,
    reading_of,
    seconds,
    why_left_out,
)
from modcal_nodes.calibrating.diagnostics import Times
from modcal_nodes.ros import LATCHED, NO_DESCRIPTION, SENSOR, GuardedNode, MonitoredSubscription, type_of

if TYPE_CHECKING:
    from modcal_nodes.calibrating.corners import CornerIntake

_JUMP = 1.0  # s
_OVERTAKEN = 500  # messages by which one topic may be ahead of another


class _MessageBlock:
    """Messages of one stretch of time. joints_from, joints_to: stamps of joint states [s]. last: of every source."""

    def __init__(self) -> None:
        self.joints_from = self.joints_to = math.nan
        self.last: dict[tuple[str, str], float] = {}
        self.count = 0
        self._builder = RecordingBuilder("live")

    def add(self, source: tuple[str, str], stamp: float, message: tuple[str, str, Any, float]) -> None:
        """Take a message. Raises BadRecording for one that contradicts itself, and counts it."""
        self.keep(message)
        self.last[source] = stamp
        self.count += 1

    def keep(self, message: tuple[str, str, Any, float]) -> None:
        """Take a message without following its stamp."""
        try:
            self._builder.add(*message)
        except BadRecording as error:
            self._builder.lose(message[0], why_left_out(error))
            raise

    def awaits(self, source: tuple[str, str], stamp: float, newer: _MessageBlock) -> bool:
        """Whether a reading that comes when a newer piece has begun is of this piece's time."""
        if newer.joints_from > self.joints_from:
            return self.joints_from <= stamp < newer.joints_from
        return source not in newer.last and stamp >= self.last.get(source, self.joints_from) - _JUMP

    def recording(self) -> Recording:
        """What was taken so far."""
        return self._builder.recording()


class Buffer:
    """Messages in pieces: a new piece begins when the clock is set back, or the last one has grown long."""

    def __init__(self, longest: float) -> None:
        """longest: seconds of messages that one piece holds."""
        self._longest = longest
        self.samples: Samples | None = None
        self.forgotten = -1  # how often everything was forgotten, beginning with nothing
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self.forgotten += 1
        self._pieces: list[Recording] = []
        self._before: _MessageBlock | None = None
        self._now = _MessageBlock()
        self._early: list[tuple[tuple[str, str], float, tuple[str, str, Any, float]]] = []
        self.samples = None
        self.dropped: Dropped = ()  # of what is remembered as samples only
        self._stamps: dict[tuple[str, str], float] = {}
        self._odd: dict[tuple[str, str], float] = {}
        self._names: frozenset[str] = frozenset()

    def add(self, topic: str, type_name: str, message: Any, received: float) -> None:
        """Take one message. Raises BadRecording for one that contradicts itself, or is stamped at another time."""
        stamp = seconds(message.header.stamp) or received
        source = (topic, str(message.header.frame_id))
        if self._elsewhen(source, stamp):
            self._now.keep((topic, type_name, message, received))  # which counts it when samples are made
            raise BadRecording(topic, f"a message is {ELSEWHEN}, at {stamp:.3f} s", "synchronise the clocks")
        if topic.endswith(JOINT_STATES):
            self._follow_clock(stamp)
            if not self._names.issuperset(message.name):
                self._names |= set(message.name)
        elif self._before is not None and self._before.awaits(source, stamp, self._now):
            self._before.add(source, stamp, (topic, type_name, message, received))
            return
        elif stamp < self._now.last.get(source, stamp) - _JUMP:
            self._early.append((source, stamp, (topic, type_name, message, received)))
            if len(self._early) > _OVERTAKEN:  # the clock of the joint states was not set back
                self._take_early()
            return
        self._now.add(source, stamp, (topic, type_name, message, received))
        if self._before is not None and self._now.count > _OVERTAKEN:
            self._pieces.append(self._before.recording())
            self._before = None

    def _elsewhen(self, source: tuple[str, str], stamp: float) -> bool:
        """Whether a stamp is of another day than the one before, and the first such: a clock that is set goes on."""
        before = self._stamps.get(source, stamp)
        if abs(stamp - before) > DAY and not abs(stamp - self._odd.get(source, math.inf)) <= _JUMP:
            self._odd[source] = stamp
            return True
        self._stamps[source] = stamp
        return False

    def _follow_clock(self, stamp: float) -> None:
        """Begin a new piece where a joint state's stamp asks for one."""
        set_back = stamp < self._now.joints_to - _JUMP
        if set_back or stamp - self._now.joints_from > self._longest:
            if self._before is not None:
                self._pieces.append(self._before.recording())
            # Each topic is taken in one go: its messages come up to a hundred before, or after, those of another. So
            # readings of the piece that ends may come yet; where the clock was set back, some since may have come.
            self._before, self._now = self._now, _MessageBlock()
            if set_back:
                self._take_early()
        self._now.joints_from = stamp if math.isnan(self._now.joints_from) else self._now.joints_from
        self._now.joints_to = stamp

    def _take_early(self) -> None:
        for early in self._early:
            self._now.add(*early)
        self._early.clear()

    def collected(self) -> SampleMemory:
        """Everything remembered."""
        self._take_early()
        open_pieces = [piece.recording() for piece in (self._before, self._now) if piece is not None]
        return SampleMemory(
            (*self._pieces, *(piece for piece in open_pieces if piece.joints)), self.samples, self.dropped
        )

    def finished(self) -> SampleMemory:
        """Everything but the present piece."""
        return SampleMemory(tuple(self._pieces), self.samples, self.dropped)

    def condensed(self, pieces: int, samples: Samples | None, dropped: Dropped = ()) -> None:
        """From now on these samples stand for what was remembered before and for so many of the oldest pieces.

        dropped: what was left out of all that, by reason.
        """
        self.samples, self.dropped = samples, dropped
        del self._pieces[:pieces]

    def left_out(self, pieces: int) -> None:
        """Forget so many of the oldest pieces, which hold no station."""
        lost = sum(len(track.stamps) for piece in self._pieces[:pieces] for track in piece.readings)
        self.condensed(pieces, self.samples, together([self.dropped, ((UNUSABLE, lost),)] if lost else [self.dropped]))

    def keep(self, pieces: int) -> None:
        """Forget all but so many of the newest finished pieces."""
        del self._pieces[: max(len(self._pieces) - pieces, 0)]

    @property
    def pieces(self) -> int:
        """How many finished pieces there are."""
        return len(self._pieces)

    def joint_names(self) -> frozenset[str]:
        """Names of all joints heard."""
        return self._names


_ANOTHER = (
    "robot_description has changed, and is not that of the arm that was recorded: clean up and configure this node, or "
    "restart it, to calibrate another robot"
)


class KnownArm:
    """description: URDF text, empty while unknown. chain, stream: None until the arm is known. trouble: why not."""

    def __init__(self, description: str, base: str, tip: str, delta: Delta | None = None) -> None:
        """description: given by a parameter, so that none is taken from the topic; empty: to be heard. delta: a robot
        that needs no description.
        """
        self.description = description
        self.delta = delta
        self.chain: Mechanism | None = None
        self.stream: SampleStream | None = None
        self.trouble = ""
        self._given, self._base, self._tip = bool(description), base, tip
        self._tried: tuple[str, frozenset[str]] | None = None
        self._largest, self._reach = np.empty(0), 0.0
        self._told: dict[tuple[str, ...], JointColumns | None] = {}

    @property
    def serial(self) -> Chain | None:
        """The arm, where it is known and a serial chain."""
        return self.chain if self.chain is not None and is_serial_arm(self.chain) else None

    def describe(self, text: str) -> None:
        """Take a description that was published. Another one, later, is refused: that is another robot."""
        if self._given or self.delta is not None:
            return
        if self.chain is None:
            self.description = text
        else:
            same = text == self.description or self._is_the_same(text)
            self.trouble = "" if same else _ANOTHER

    def _is_the_same(self, text: str) -> bool:
        assert self.chain is not None
        try:
            return fingerprint(read_chain(text, self.chain.base, self.chain.tip)) == fingerprint(self.chain)
        except ModcalError:
            return False

    def recognise(self, names: frozenset[str]) -> bool:
        """Read the arm, given the names of all joints heard so far; returns whether it has become known just now."""
        known = bool(self.description) or self.delta is not None
        if self.chain is not None or not known or not names or self._tried == (self.description, names):
            return False
        self._tried = self.description, names  # reading a description takes as long as a hundred messages
        chain: Mechanism
        try:
            chain = self.delta or read_chain(self.description, self._base or None, self._tip or None, names)
        except ModcalError as error:
            self.trouble = str(error)
            return False
        told = JointColumns.of(chain.names, chain.follows, sorted(names)).joints
        if len(told) < chain.n:
            missing = ", ".join(name for j, name in enumerate(chain.names) if j not in told)
            self.trouble = f"joint_states does not name {missing} yet"
            return False
        self.chain, self.trouble = chain, ""
        self.stream = SampleStream(chain.names)
        self._largest, self._reach = joint_limits(chain), chain.reach()
        return True

    def joint_state(self, message: Any) -> None:
        """Hand a joint state to the stream, if it names the whole arm, in any order and among others."""
        names = tuple(message.name)
        if self.stream is None or self.chain is None:
            return
        if names not in self._told:
            columns = JointColumns.of(self.chain.names, self.chain.follows, names)
            self._told[names] = columns if len(columns.joints) == self.chain.n else None
        told = self._told[names]
        if told is not None:
            effort = told.efforts(np.frombuffer(message.effort)) if len(message.effort) == len(names) else None
            position = told.positions(np.frombuffer(message.position))
            if (np.abs(position) > self._largest).any():
                worst = int(np.argmax(np.abs(position) / self._largest))
                said = f"position {position[worst]:.4g}, {self._largest[worst]:.4g} is the limit"
                raise BadRecording(f"joint {self.chain.names[worst]}", said, "publish radians and metres")
            self.stream.joint_state(seconds(message.header.stamp), position, effort)

    def command(self, type_name: str, message: Any, received: float) -> None:
        """Add a message of commands to the stream; joints that it does not name keep their last command."""
        if self.stream is None or self.chain is None:
            return
        told = Commands()
        stamp = seconds(message.header.stamp) or received
        told.take(JOINT_COMMANDS, type_name, OneMessage(message), np.array([stamp]), np.array([received]))
        for track in told.tracks(lambda _: 0):
            if len(track.stamps):
                unnamed = np.full(len(track.stamps), np.nan)
                columns = [
                    track.position[:, track.names.index(name)] if name in track.names else unnamed
                    for name in self.chain.names
                ]
                self.stream.command(track.stamps, np.stack(columns, axis=1))

    def position(self, message: Any) -> np.ndarray | None:
        """The arm's joints in a joint state, (n,); None where it does not name the whole arm."""
        told = self._told.get(tuple(message.name))
        return None if told is None else told.positions(np.frombuffer(message.position))

    def reading(self, kind: str, message: Any) -> None:
        """Hand a reading to the stream."""
        if self.stream is not None:
            values = reading_of(kind, message)
            if np.isfinite(values).all() and kinds()[kind].implausible(values[None], self._reach).any():
                said = f"reads {', '.join(f'{x:.4g}' for x in values)}"
                raise BadRecording(f"{kind} in {message.header.frame_id}", said, "publish metres and unit quaternions")
            self.stream.reading(kind, message.header.frame_id, seconds(message.header.stamp), values)


class Intake:
    """times: how long messages took, and how late they came. refused: how many could not be used."""

    def __init__(
        self,
        node: Node,
        buffer: Buffer,
        arm: KnownArm,
        supervisor: Supervisor,
        recognise: Callable[[], None],
        camera: CornerIntake | None = None,
    ) -> None:
        """recognise: called with each joint state while the arm is not known. camera: takes corners, if any."""
        self._clock, self._log = node.get_clock(), node.get_logger()
        self._buffer, self._arm, self._supervisor, self._recognise = buffer, arm, supervisor, recognise
        self._camera = camera
        self.times = Times()
        self.refused = 0

    def joint_state(self, message: Any) -> None:
        """Take a joint state."""
        began = self.times.begin()
        if self.remember("joint_states", message):
            if self._arm.chain is None:
                self._recognise()
            self._feed(partial(self._arm.joint_state, message))
            if self._camera is not None and (q := self._arm.position(message)) is not None:
                self._camera.joint_state(seconds(message.header.stamp), q)
        self.times.end(began)

    def reading(self, topic: str, kind: str, message: Any) -> None:
        """Take a reading of this kind."""
        began = self.times.begin()
        if self.remember(topic, message):
            self._feed(partial(self._arm.reading, kind, message))
        self.times.end(began)
        self.times.late.append(1e-9 * self._clock.now().nanoseconds - seconds(message.header.stamp))

    def command(self, type_name: str, message: Any) -> None:
        """Take what the joints are told, in a message of this type."""
        if self.remember(JOINT_COMMANDS, message, type_name):
            received = 1e-9 * self._clock.now().nanoseconds
            self._feed(partial(self._arm.command, type_name, message, received))

    def corners(self, camera: int, message: Any) -> None:
        """Take the corners of an image of the first camera (0) or a further one."""
        assert self._camera is not None
        try:
            self._camera.every[camera].corners(message)
        except ModcalError as error:
            self._refuse(error)

    def remember(self, topic: str, message: Any, type_name: str | None = None) -> bool:
        """Put a message into the buffer; returns whether it could be used. type_name: None for the topic's own."""
        received = 1e-9 * self._clock.now().nanoseconds
        try:
            self._buffer.add(f"/{topic}", type_name or TYPES[topic], message, received)
        except ModcalError as error:
            self._refuse(error)
            return False
        return True

    def _feed(self, take: Callable[[], None]) -> None:
        try:
            take()
        except ModcalError as error:
            self._refuse(error)
        for sample in self._arm.stream.take() if self._arm.stream else ():
            self._supervisor.add(sample)

    def _refuse(self, error: ModcalError) -> None:
        self.refused += 1
        self._log.warning(str(error), throttle_duration_sec=5.0)


def listen(
    node: GuardedNode,
    intake: Intake,
    describe: Callable[[String], None],
    patience: float,
    described: bool,
    corners: Sequence[str],
) -> list[MonitoredSubscription]:
    """The subscriptions. patience: seconds of silence that are accepted. described: whether the arm is known without
    robot_description. corners: topics with those of a target, none where none are taken.
    """
    hear = partial(MonitoredSubscription, node, patience=patience, single=True)
    inputs = [hear(JointState, "joint_states", intake.joint_state, SENSOR, needed=True)]
    for kind in kinds().values():
        take = partial(intake.reading, kind.topic, kind.name)
        inputs.append(hear(type_of(kind.message), kind.topic, take, SENSOR, single=False))
    inputs.append(hear(Temperature, "temperature", partial(intake.remember, "temperature"), SENSOR, single=False))
    for camera, topic in enumerate(corners):
        inputs.append(hear(PointCloud2, topic, partial(intake.corners, camera), SENSOR))
    return [*inputs, hear(String, "robot_description", describe, LATCHED, needed=not described)]


# --- What a calibrator needs before it can work: topics that have not come yet, and a policy that there is

_NO_JOINTS = "joint_states: not received yet: start the robot's driver, or remap the topic"
_NO_TRACKER = "tracker/pose, tracker/point and other readings: none received yet: start the tracker, or remap its topic"
_NO_CORNERS = "corners: not received yet: start board_detector, or remap its topic"


def lacking(arm: KnownArm, inputs: Iterable[MonitoredSubscription], by_camera: bool) -> str:
    """What must come before stations can be cut, or images be kept, or keeps them from being used; empty: nothing."""
    if arm.chain is not None and arm.trouble:
        return arm.trouble
    if arm.chain is None:
        if not arm.description and arm.delta is None:
            return NO_DESCRIPTION
        return arm.trouble or _NO_JOINTS
    topics = ("corners",) if by_camera else tuple(kind.topic for kind in kinds().values())
    if any(subscription.count for subscription in inputs if subscription.topic.endswith(topics)):
        return ""
    return _NO_CORNERS if by_camera else _NO_TRACKER


def policy(chosen: dict[str, Any]) -> Policy:
    """When results are trusted, and when a solve starts by itself. Raises BadTable for what is no policy."""
    if chosen["accept"] not in (ASKED, BETTER):
        raise BadTable(f"accept '{chosen['accept']}'", f"{BETTER} and {ASKED} are known", "set one of them")
    return Policy(chosen["accept"], chosen["first_solve"], chosen["after_change"])


_LOOK = 1.0  # s between looks at who publishes


class CommandSubscription:
    """Subscribes to ``joint_commands`` with the type that its publisher has."""

    def __init__(self, node: GuardedNode, hear: Callable[[str, Any], None]) -> None:
        """hear: called with the type's name and the message."""
        self._node, self._hear = node, hear
        self._topic = node.resolve_topic_name(JOINT_COMMANDS)
        self._next = 0.0
        self._found = False

    def look(self) -> MonitoredSubscription | None:
        """The subscription, once, when somebody has begun to publish."""
        if self._found or time.monotonic() < self._next:
            return None
        self._next = time.monotonic() + _LOOK
        for info in self._node.get_publishers_info_by_topic(self._topic):
            if info.topic_type in accepted(JOINT_COMMANDS):
                self._found = True
                hear = partial(self._hear, info.topic_type)
                return MonitoredSubscription(self._node, type_of(info.topic_type), JOINT_COMMANDS, hear, SENSOR)
        return None

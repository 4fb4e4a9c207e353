"""Wishes and joint states as they come over the wire, checked at the door; poses and bounds as they go out."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from modcal_core.articulation import JointModel
from modcal_core.errors import BadCommand, ModcalError
from modcal_core.geometry import Array, se3
from modcal_core.impedance import ArmSetpoint
from modcal_core.robots import Follower, JointColumns
from modcal_msgs_py.readings import seconds, set_seconds

_UNIT = 1e-3  # how far from one the length of a quaternion may be
_FASTEST = 100.0  # rad/s or m/s
_BEYOND = 0.1  # rad or m outside the limits that a joint may be reported


def desired_pose(message: Any, farthest: float) -> Array:
    """The pose (4, 4) [m] of a PoseStamped; raises BadCommand for one that is no pose.

    farthest: no sensible position is this far from its frame's origin [m].
    """
    p, q = message.pose.position, message.pose.orientation
    numbers = np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w], dtype=float)
    if not np.isfinite(numbers).all():
        raise BadCommand("desired_pose", "is not finite", "send numbers")
    length = math.hypot(*numbers[3:])
    if abs(length - 1.0) > _UNIT:
        raise BadCommand("desired_pose", f"its quaternion has length {length:.4g}", "send a unit quaternion x y z w")
    far = math.hypot(*numbers[:3])
    if far > farthest:
        unit = "; it looks like millimetres" if far > 50.0 * farthest else ""
        raise BadCommand(
            "desired_pose", f"lies {far:.4g} m away, the arm reaches {farthest:.3g} m{unit}", "send metres within reach"
        )
    return se3.from_pose(numbers)


def require_new(message: Any, now: float, stale: float) -> None:
    """Raises BadCommand for a stamped wish that is too old, or from another clock; one without a stamp is of now."""
    stamp = seconds(message.header.stamp) or now
    _require_recent("desired_pose", stamp, now, stale, "stamp it with this clock when it is sent")


def _require_recent(what: str, stamp: float, now: float, stale: float, remedy: str) -> None:
    if not abs(now - stamp) <= stale:
        when = "old" if stamp < now else "ahead"
        raise BadCommand(what, f"its stamp is {abs(now - stamp):.3g} s {when}, {stale:g} s is the limit", remedy)


class JointInput:
    """The newest position, velocity and effort of every joint of an arm, from messages in any order and any parts."""

    def __init__(self, names: Sequence[str], lower: Array, upper: Array, follows: Sequence[Follower] = ()) -> None:
        """Wait for these joints; positions far outside the limits are refused.

        follows: those that mimic another one, and stand where that one puts them unless a message names them.
        """
        self.names, self._follows = tuple(names), tuple(follows)
        self._lower, self._upper = lower - _BEYOND, upper + _BEYOND
        self._told: tuple[str, ...] | None = None  # names of the last message ...
        self._named = JointColumns.of(self.names, (), ())  # ... and which of them are which of this arm's joints,
        self._low, self._high = self._lower[:0], self._upper[:0]  # with their limits
        self.complete = False  # whether every joint was heard of
        n = len(self.names)
        self.position, self.velocity, self.effort = np.zeros(n), np.zeros(n), np.full(n, math.nan)
        self.stamps = np.full(n, -math.inf)

    def receive(self, message: Any, now: float, stale: float) -> None:
        """Take a JointState received at ``now`` [s]. Raises BadCommand for one that is wrong or older than ``stale``.

        Joints of other arms are passed over; a message without a stamp counts as sent when it was received.
        """
        stamp = seconds(message.header.stamp) or now
        remedy = "make the driver stamp with this clock, or check why it is late"
        _require_recent("joint_states", stamp, now, stale, remedy)
        names = tuple(message.name)
        if names != self._told:
            self._told = None
            self._named = JointColumns.of(self.names, self._follows, names)
            self._low, self._high = self._lower[self._named.joints], self._upper[self._named.joints]
        if len(message.position) != len(names) or (self._told is None and len(set(names)) != len(names)):
            raise BadCommand(
                "joint_states", f"{len(message.position)} positions for {len(names)} names", "send one for every name"
            )
        self._told = names
        named, column = self._named, self._named.joints
        if not len(column):
            return
        q = named.positions(np.asarray(message.position, dtype=float))
        within = (q >= self._low) & (q <= self._high)  # NaN is neither
        if not within.all():
            worst = int(np.argmin(within))
            raise BadCommand(
                f"joint_states of {self.names[column[worst]]}",
                f"{q[worst]:.4g} is far outside its limits",
                "send radians and metres of this robot",
            )
        self.position[column] = q
        self.stamps[column] = stamp
        velocity, effort = (np.asarray(told, dtype=float) for told in (message.velocity, message.effort))
        self.velocity[column] = named.velocities(velocity) if len(velocity) == len(names) else 0.0
        self.effort[column] = named.efforts(effort) if len(effort) == len(names) else math.nan
        # no joint goes this fast: a driver that sends it does not know, and then nothing is made of it
        slow = np.abs(self.velocity) < _FASTEST
        if not slow.all():
            self.velocity[~slow] = 0.0
        self.complete = self.complete or not self.missing()

    def missing(self) -> tuple[str, ...]:
        """Joints without any message so far."""
        return tuple(name for name, stamp in zip(self.names, self.stamps, strict=True) if stamp == -math.inf)

    def require_fresh(self, now: float, stale: float) -> None:
        """Raises BadCommand unless every joint was received within ``stale`` seconds of ``now``."""
        if self._told is None:
            raise BadCommand("joint_states", "no message was received", "check that the driver is alive")
        if missing := self.missing():
            raise BadCommand(
                "joint_states", f"do not contain {', '.join(missing)}", "publish every joint between base and tip"
            )
        age = np.abs(now - self.stamps)
        j = int(np.argmax(age))
        if not age[j] <= stale:
            raise BadCommand(
                f"joint_states of {self.names[j]}",
                f"are {age[j]:.3g} s off, {stale:g} s is the limit",
                "check that the driver is alive and its clock is this one",
            )


def fill_pose(message: Any, T: Array, covariance: Array | None = None) -> None:
    """Write a pose (4, 4) into a Pose, or with its covariance (6, 6) into a PoseWithCovariance."""
    pose = message if covariance is None else message.pose
    x, y, z, qx, qy, qz, qw = (float(v) for v in se3.to_pose(T))
    pose.position.x, pose.position.y, pose.position.z = x, y, z
    pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = qx, qy, qz, qw
    if covariance is not None:
        message.covariance = [float(v) for v in covariance.ravel()]


def fill_accelerations(message: Any, names: Sequence[str], values: Array, stamp: float) -> None:
    """Write bounds of accelerations (n,) by joint into a JointTrajectory with one point.

    The point holds no positions, so that no controller takes it for a motion.
    """
    message.joint_names = list(names)
    message.points[0].accelerations = [float(v) for v in values]
    set_seconds(message.header.stamp, stamp)


# --- Setpoints of an impedance as the messages that stacks take, wrenches both ways, and the estimate of an object

_LONGEST_URDF = 100_000  # characters of a description with one joint
_MAX_VALUES = 64


def wrench_numbers(message: Any) -> Array:
    """Force and moment (6,) [N, N m] of a WrenchStamped."""
    f, m = message.wrench.force, message.wrench.torque
    return np.array([f.x, f.y, f.z, m.x, m.y, m.z], dtype=float)


def fill_wrench(message: Any, frame: str, stamp: float, numbers: Array) -> Any:
    """A WrenchStamped, filled with six numbers along and about the axes of a frame."""
    message.header.frame_id = frame
    set_seconds(message.header.stamp, stamp)
    f, m = message.wrench.force, message.wrench.torque
    f.x, f.y, f.z, m.x, m.y, m.z = (float(x) for x in numbers)
    return message


def fill_target(message: Any, setpoint: ArmSetpoint, stamp: float) -> Any:
    """A PoseStamped of where the tool shall be, in the base link."""
    message.header.frame_id = setpoint.frame
    set_seconds(message.header.stamp, stamp)
    fill_pose(message.pose, setpoint.pose)
    return message


def fill_point(message: Any, setpoint: ArmSetpoint, after: float, with_speed: bool = True) -> Any:
    """A JointTrajectoryPoint of the joints, to be reached so many seconds after it was sent.

    with_speed: false where it is the end of a trajectory, which controllers want to stand at.
    """
    message.positions = setpoint.q.tolist()
    message.velocities = setpoint.velocity.tolist() if with_speed else []
    set_seconds(message.time_from_start, after)
    return message


class ObjectInput:
    """What is believed of the object: ``model``, ``trusted``, ``event``, from the messages that tell of it.

    A description alone is not trusted: its status must say so, and be no older than ``stale`` [s]. One in another frame
    than the arm's base is no model: the numbers would be followed at another place.
    """

    def __init__(
        self, read: Callable[[str], JointModel], frames: Callable[[str], tuple[str, str]], stale: float = 1.0
    ) -> None:
        """read, frames: the model of a URDF text, and its first link and last; may raise ModcalError."""
        self._read, self._frames, self._stale = read, frames, stale
        self._model: JointModel | None = None
        self._frame, self._base = "", ""
        self.kind = ""
        self.event: str | None = None
        self._trusted, self._stamp, self._now = False, -math.inf, 0.0
        self._text = ""

    def hear_description(self, message: Any) -> None:
        """Take the URDF of the object. Raises ModcalError, and believes in no model, for one that is none."""
        text = str(message.data)
        if text == self._text:
            return
        self._text, self._model = text, None
        if not text:
            return
        if len(text) > _LONGEST_URDF:
            raise BadCommand("object_description", f"has {len(text)} characters", "publish a URDF of one joint")
        try:
            self._frame = self._frames(text)[0]
            self._model = self._read(text)
        except ModcalError:
            raise
        except (ValueError, KeyError, TypeError) as error:
            raise BadCommand("object_description", f"cannot be read ({error})", "publish a URDF of one joint") from None
        if self.elsewhere:
            raise BadCommand("object_description", self.elsewhere, "track the handle in the arm's base link")

    def in_base(self, base: str) -> None:
        """Believe from now on only in what is described in this link."""
        self._base = base

    @property
    def model(self) -> JointModel | None:
        """How the tool moves, in the arm's base; None where that is not known."""
        return None if self.elsewhere else self._model

    @property
    def elsewhere(self) -> str:
        """As text, that what was described is in another frame than the arm's base; empty where it is not."""
        if self._model is None or not self._base or self._frame == self._base:
            return ""
        return f"is in frame '{self._frame}', the arm begins at '{self._base}'"

    def hear_status(self, message: Any, now: float) -> None:
        """Take a DiagnosticArray that tells whether the model is trusted, and what happened to the object."""
        for status in message.status:
            told = {str(pair.key): str(pair.value) for pair in list(status.values)[:_MAX_VALUES]}
            if "trusted" in told:
                stamp = seconds(message.header.stamp) or now
                self._stamp = stamp if abs(now - stamp) <= self._stale else -math.inf
                self._trusted = told["trusted"].lower() == "true"
                self.kind = told.get("kind", "")
                event = told.get("event", "")
                self.event = event if event.lower() not in ("", "none", "null") else None

    def at(self, now: float) -> ObjectInput:
        """Itself, as believed at a time [s]."""
        self._now = now
        return self

    @property
    def trusted(self) -> bool:
        """Whether the model is trusted at the time of :meth:`at`."""
        return self._trusted and self.model is not None and not self.silent

    @property
    def silent(self) -> bool:
        """Whether no status was received for ``stale`` [s] before the time of :meth:`at`."""
        return not abs(self._now - self._stamp) <= self._stale

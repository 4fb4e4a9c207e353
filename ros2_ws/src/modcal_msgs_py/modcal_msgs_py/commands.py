"""Wishes and joint states as they come over the wire, checked at the door; poses and bounds as they go out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from modcal_core.errors import BadCommand
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_msgs_py.stamps import seconds, set_seconds

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
    stamp = seconds(message.header.stamp)
    if stamp and not abs(now - stamp) <= stale:
        when = "old" if stamp < now else "ahead"
        raise BadCommand(
            "desired_pose",
            f"its stamp is {abs(now - stamp):.3g} s {when}, {stale:g} s is the limit",
            "stamp it with this clock when it is sent",
        )


class JointInput:
    """The newest position, velocity and effort of every joint of an arm, from messages in any order and any parts."""

    def __init__(self, names: Sequence[str], lower: Array, upper: Array) -> None:
        """Wait for these joints; positions far outside the limits are refused."""
        self.names = tuple(names)
        self._column = {name: j for j, name in enumerate(self.names)}
        self._lower, self._upper = lower - _BEYOND, upper + _BEYOND
        self._told: tuple[str, ...] | None = None  # names of the last message ...
        self._rows = self._columns = np.empty(0, int)  # ... and which of them are which of this arm's joints,
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
        if not abs(now - stamp) <= stale:
            when = "old" if stamp < now else "ahead"
            raise BadCommand(
                "joint_states",
                f"its stamp is {abs(now - stamp):.3g} s {when}, {stale:g} s is the limit",
                "make the driver stamp with this clock, or check why it is late",
            )
        names = tuple(message.name)
        if names != self._told:
            self._told = None
            known = [(i, self._column[name]) for i, name in enumerate(names) if name in self._column]
            self._rows, self._columns = np.array(known, int).reshape(-1, 2).T
            self._low, self._high = self._lower[self._columns], self._upper[self._columns]
        if len(message.position) != len(names) or (self._told is None and len(set(names)) != len(names)):
            raise BadCommand(
                "joint_states", f"{len(message.position)} positions for {len(names)} names", "send one for every name"
            )
        self._told = names
        at, column = self._rows, self._columns
        if not len(at):
            return
        q = np.asarray(message.position, dtype=float)[at]
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
        for values, kept, unknown in ((message.velocity, self.velocity, 0.0), (message.effort, self.effort, math.nan)):
            told = np.asarray(values, dtype=float)
            kept[column] = told[at] if len(told) == len(names) else unknown
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

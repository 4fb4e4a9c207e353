"""Setpoints of an impedance as the messages that stacks take, wrenches both ways, and the estimate of an object."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from modcal_core.articulation.joints import JointModel
from modcal_core.errors import BadCommand, ModcalError
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.impedance.safety_monitor import ArmSetpoint
from modcal_msgs_py.stamps import seconds, set_seconds

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
    p, q = message.pose.position, message.pose.orientation
    p.x, p.y, p.z, q.x, q.y, q.z, q.w = (float(x) for x in se3.to_pose(setpoint.pose))
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

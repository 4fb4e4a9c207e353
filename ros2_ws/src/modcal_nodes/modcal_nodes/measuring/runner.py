"""One station after the other on a real arm: what to send now, and when to hold. No ROS in it, and no clock of its own.

It is asked every period what to do, with the time and what the joints report. While the arm moves, every period checks
that joint states are fresh, that the arm is where the motion wants it, and within limits; any doubt holds the arm. At a
station it waits until the joints stand, then for readings; where none come the station is not seen.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from modcal_core.geometry import Array, so3
from modcal_core.measurements import TRAVEL
from modcal_core.planning import UNSEEN, Station, TimedMotion
from modcal_core.robots import Mechanism
from modcal_msgs_py import JointInput

if TYPE_CHECKING:
    from sensor_msgs.msg import JointState

IDLE, MOVING, SETTLING, READING, HELD = "idle", "moving", "settling", "reading", "held"
_BEYOND = 1e-3  # rad or m outside a limit that a report may be, for rounding


@dataclass(frozen=True)
class Rules:
    """stale: [s] after which joint states are too old. off: rad or m that the arm may be from where the motion has it.
    arrived: rad or m from a station. settle: [s] that it stands before it is read. patience: [s] for the arm to arrive
    after the motion's end, and for readings. readings: how many are averaged.
    """

    stale: float = 0.2
    off: float = 0.1
    arrived: float = 0.01
    settle: float = 0.5
    patience: float = 5.0
    readings: int = 10
    still: float = 1e-3  # rad or m that a joint may move while it settles


@dataclass(frozen=True)
class JointReport:
    """What the joints report: q (n,), and when it was received [s]; effort (n,), NaN where not sent."""

    q: Array
    received: float
    effort: Array | None = None


@dataclass(frozen=True)
class Hold:
    """Stop here, (n,), because of this."""

    q: Array
    why: str


@dataclass(frozen=True)
class Done:
    """A station was measured, or was not seen."""

    number: int
    station: Station


Answer = Hold | Done | None


@dataclass
class Runner:
    """lower, upper: limits of the joints (n,). phase: what it is doing."""

    lower: Array
    upper: Array
    rules: Rules = field(default_factory=Rules)
    phase: str = IDLE
    why: str = ""
    _number: int = -1
    _station: Station | None = None
    _motion: TimedMotion | None = None
    _began: float = 0.0
    _since: float = 0.0
    _stood: Array | None = None
    _read: list[tuple[float, Array]] = field(default_factory=list)
    _seen: list[Array] = field(default_factory=list)
    _effort: list[Array] = field(default_factory=list)

    @property
    def busy(self) -> bool:
        """Whether a station is being measured."""
        return self.phase in (MOVING, SETTLING, READING)

    def begin(self, number: int, station: Station, motion: TimedMotion, now: float) -> None:
        """Go to a station, the motion being sent to the controller. Only from idle, and one at a time."""
        assert self.phase == IDLE, self.phase
        self.phase, self._number, self._station = MOVING, number, station
        self._motion, self._began = motion, now

    def hold(self, q: Array | None, why: str, now: float) -> Hold | None:
        """Stop, at q (n,), or where that is not known where the motion should be now; nothing to send at rest."""
        moving, motion = self.phase == MOVING, self._motion
        self.phase, self.why = HELD, why
        if not moving or motion is None:
            return None
        return Hold(motion.at(now - self._began) if q is None else q, why)

    def release(self) -> None:
        """Be ready for a station again, after a hold or before the first."""
        self.phase, self.why = IDLE, ""

    def take_reading(self, reading: Array, stamp: float, received: float) -> None:
        """A reading of the instrument: x y z, of a pose qx qy qz qw behind them."""
        if self.phase == READING and received >= self._since and len(self._read) < self.rules.readings:
            self._read.append((stamp, reading))

    def tick(self, now: float, joints: JointReport | None) -> Answer:
        """What to do now."""
        if not self.busy:
            return None
        if joints is None or not 0.0 <= now - joints.received <= self.rules.stale:
            return self.hold(None, f"joint states are older than {self.rules.stale:g} s", now)
        outside = np.maximum(self.lower - joints.q, joints.q - self.upper)
        if outside.max() > _BEYOND:
            return self.hold(joints.q, f"joint {int(np.argmax(outside)) + 1} is outside its limits", now)
        if self.phase == MOVING:
            return self._move(now, joints)
        return self._stand(now, joints)

    def _move(self, now: float, joints: JointReport) -> Answer:
        assert self._motion is not None
        after = now - self._began
        # a controller lags behind: what counts is how far the arm is from where it should be now or a moment ago
        lag = [self._motion.at(max(after - d, 0.0)) for d in (0.0, 0.1, 0.2, 0.4)]
        off = min(float(np.abs(joints.q - q).max()) for q in lag)
        if off > self.rules.off:
            return self.hold(
                joints.q, f"the arm is {off:.3f} rad or m from its way, {self.rules.off:g} is the limit", now
            )
        if after < float(self._motion.t[-1]):
            return None
        if np.abs(joints.q - self._motion.end).max() <= self.rules.arrived:
            self.phase, self._since, self._stood = SETTLING, now, joints.q
        elif after > float(self._motion.t[-1]) + self.rules.patience:
            missing = float(np.abs(joints.q - self._motion.end).max())
            return self.hold(joints.q, f"the arm did not arrive: {missing:.3f} rad or m are missing", now)
        return None

    def _stand(self, now: float, joints: JointReport) -> Answer:
        assert self._stood is not None
        if np.abs(joints.q - self._stood).max() > self.rules.still:
            if self.phase == READING and np.abs(joints.q - self._stood).max() > self.rules.arrived:
                return self.hold(joints.q, "the arm moved while it was read", now)
            self.phase, self._since, self._stood = SETTLING, now, joints.q
            self._forget()
            return None
        if self.phase == SETTLING:
            if now - self._since >= self.rules.settle:
                self.phase, self._since = READING, now
                self._forget()
            return None
        self._seen.append(joints.q)
        if joints.effort is not None:
            self._effort.append(joints.effort)
        if len(self._read) >= self.rules.readings:
            return self._finish(self._measured())
        if now - self._since > self.rules.patience:
            assert self._station is not None
            enough = len(self._read) >= max(self.rules.readings // 2, 1)
            return self._finish(self._measured() if enough else replace(self._station, state=UNSEEN))
        return None

    def _measured(self) -> Station:
        assert self._station is not None
        reading, scatter = averaged(np.array([reading for _, reading in self._read]))
        effort = np.mean(self._effort, axis=0) if self._effort else None
        stamp = float(np.mean([stamp for stamp, _ in self._read]))
        q = np.mean(self._seen, axis=0)
        return self._station.measured(reading, q, stamp=stamp, sigma=scatter, effort=effort, approach=self._came())

    def _came(self) -> Array:
        """The way in which each joint last moved, −1, 0 (it did not) or 1, (n,)."""
        assert self._motion is not None
        steps = np.diff(self._motion.q, axis=0)
        moved = np.abs(steps) > TRAVEL / len(steps)
        last = len(steps) - 1 - np.argmax(moved[::-1], axis=0)
        way = np.sign(steps[last, np.arange(steps.shape[1])])
        return np.asarray(np.where(moved.any(axis=0), way, 0.0))

    def _finish(self, station: Station) -> Done:
        self.phase = IDLE
        self._forget()
        return Done(self._number, station)

    def _forget(self) -> None:
        self._read, self._seen, self._effort = [], [], []


def averaged(readings: Array) -> tuple[Array, float]:
    """The mean of readings x y z (m, 3), of poses qx qy qz qw behind them, and the standard deviation of its position
    per axis [m]; NaN of one reading.
    """
    count, mean = len(readings), readings[:, :3].mean(axis=0)
    if readings.shape[1] > 3:
        mean = np.r_[mean, so3.to_quaternion(so3.mean(so3.from_quaternion(readings[:, 3:])))]
    scatter = np.sqrt(np.mean(np.var(readings[:, :3], axis=0, ddof=1)) / count) if count > 1 else np.nan
    return mean, float(scatter)


class JointReports:
    """The newest report of all joints. limits: lowest and highest positions (n,) [rad, m]. clock: seconds of the node's
    own time, in which messages are stamped.
    """

    def __init__(self, robot: Mechanism, limits: tuple[Array, Array], clock: Callable[[], float]) -> None:
        self._joints, self._clock = JointInput(robot.names, *limits, robot.follows), clock
        self._received = -np.inf

    def receive(self, message: JointState, stale: float) -> None:
        """Take a message. Raises BadCommand for one that is wrong or older than ``stale`` [s]."""
        self._joints.receive(message, self._clock(), stale)
        self._received = time.monotonic()

    def require_fresh(self, stale: float) -> None:
        """Raises BadCommand unless every joint was received within so many seconds."""
        self._joints.require_fresh(self._clock(), stale)

    @property
    def position(self) -> Array | None:
        """Where the joints are (n,), None while some were never heard of."""
        return None if self._joints.missing() else self._joints.position.copy()

    def now(self) -> JointReport | None:
        """The report; None while some joints were never heard of."""
        q = self.position
        if q is None:
            return None
        effort = self._joints.effort.copy()
        # joints may come in messages of several drivers: the one heard longest ago counts
        age = max(self._clock() - float(self._joints.stamps.min()), 0.0)
        received = min(self._received, time.monotonic() - age)
        return JointReport(q, received, effort if np.isfinite(effort).all() else None)

"""``station_runner``: an arm measures itself until a wanted accuracy is proven. A lifecycle node."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.clock import Clock, ClockType
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from modcal_core.errors import BadTable, ModcalError
from modcal_core.planning import TimedMotion
from modcal_msgs_py import fill_identity, seconds, set_seconds
from modcal_nodes import ros
from modcal_nodes.measuring import StationSequence

_NOT_REACHED = 5  # outcome of Measure: it has ended, and the accuracy is not proven
_READINGS = {"pose": (PoseStamped, "tracker/pose"), "point": (PointStamped, "tracker/point")}
_STEADY = Clock(clock_type=ClockType.STEADY_TIME)  # a simulated time that stands must not keep an arm from being held


class StationRunner(ros.ManagedNode):
    """Moves an arm from station to station. Nothing moves at launch, and nothing before a dry run was accepted."""

    def __init__(self) -> None:
        super().__init__("station_runner", ros.STATION_RUNNER)

    def _check(self, new: dict[str, Any]) -> None:
        if new["measurement"] not in _READINGS:
            raise BadTable(f"measurement '{new['measurement']}'", "must be pose or point", "set one of them")

    def _serve(self) -> None:
        # what the arm would do first; asking for ~/start after that accepts it
        self.offer("~/dry_run", lambda: self._sequence.show(self.said))
        self.offer("~/start", lambda: (not (refusal := self._begin()), refusal or "measuring"))
        self.offer("~/stop", lambda: (True, "held" if self._sequence.stop() else "nothing moved"))
        self._action = ros.Action(self, "Measure", self._begin, self._cancel, self._progress)

    def _configure(self) -> None:
        """Begin to listen."""
        self._sequence = StationSequence(self._chosen, self._send, self._tell, self._now)
        self.held.callback(self._sequence.close)
        self._trajectory = self.create_publisher(JointTrajectory, "~/joint_trajectory", 10)
        kind, topic = _READINGS[self._chosen["measurement"]]
        heard: list[tuple[type, str, Callable[[Any], None], Any]] = [
            (JointState, "joint_states", self._sequence.take_joints, ros.FRESH),
            (kind, topic, self._take_reading, ros.FRESH),
        ]
        if self._chosen["robot_description"]:
            self._sequence.describe(self._chosen["robot_description"])
        else:
            heard.append((String, "robot_description", lambda m: self._sequence.describe(m.data), ros.LATCHED))
        self._inputs = [self.hear(*one, needed=True, single=True) for one in heard]
        self._tell(ros.OK, "waiting for the robot description and joint states")

    def _activate(self) -> None:
        """Check every period from here on: it makes its dry run, and moves nothing."""
        self._sequence.activate()
        self.create_timer(1.0 / self._chosen["rate_hz"], self._tick, clock=_STEADY)

    def _deactivate(self) -> None:
        """Hold the arm; a new dry run has to be accepted before it moves again. What was measured is in the folder."""
        self._sequence.rest("deactivated")
        self._see_end()

    def _begin(self) -> str:
        """Begin, or go on; returns why not, or nothing."""
        try:
            self._sequence.start(self.said)
        except ModcalError as error:
            return str(error)
        return ""

    def _cancel(self) -> None:
        self._sequence.stop()
        self._see_end()

    def _progress(self, feedback: Any) -> None:
        feedback.phase, feedback.message = str(self._sequence.facts["phase"]), self.said
        feedback.stations = self._sequence.measured
        if (advice := self._sequence.advice) is not None:
            feedback.expected_m, feedback.proven_m = _known(advice.status.expected), _known(advice.status.bound)

    def _see_end(self) -> None:
        """Say how it has ended, once it goes to stations no more."""
        if self._sequence.running:
            return
        advice, ended = self._sequence.advice, ros.FAILED
        if advice is not None and advice.outcome is not None:
            ended = ros.DONE if advice.outcome.ending == "proven" or self._chosen["goal_mm"] == 0.0 else _NOT_REACHED
        proven = _known(None if advice is None else advice.status.bound)
        about = ros.interface("Identity")()
        fill_identity(about, self._sequence.chain, [f"tracker/{self._chosen['measurement']}"])
        self._action.end(ended, self.said, stations=self._sequence.measured, proven_m=proven, about=about)

    def _take_reading(self, message: Any) -> None:
        if isinstance(message, PointStamped):
            p = message.point
            reading = np.array([p.x, p.y, p.z])
        else:
            p, r = message.pose.position, message.pose.orientation
            reading = np.array([p.x, p.y, p.z, r.x, r.y, r.z, r.w])
        self._sequence.take_reading(reading, seconds(message.header.stamp) or self._now())

    def _tick(self) -> None:
        """One look at everything; a fault holds the arm."""
        try:
            self._sequence.look()
        except Exception as error:
            if not self.context.ok():
                raise
            said = self.faults.note("tick", error)
            self._sequence.halt(said)
            self._tell(ros.ERROR, said)
        if self._action.active:
            self._see_end()

    def _send(self, motion: TimedMotion) -> None:
        message = JointTrajectory(joint_names=list(self._sequence.names))  # without a stamp: from now on
        for after, q, v in zip(motion.t[1:], motion.q[1:], motion.v[1:], strict=True):
            point = JointTrajectoryPoint(positions=q.tolist(), velocities=v.tolist())
            set_seconds(point.time_from_start, float(after))
            message.points.append(point)
        self._trajectory.publish(message)

    def _report(self) -> list[ros.Status]:
        refused = self._refusals.recent()
        return [
            ros.subscription_status(self._inputs, self._refusals),
            ros.Status("measuring", self.level, self.said, self._sequence.facts),
            ros.Status("inputs", ros.WARN if refused else ros.OK, refused or "nothing was refused"),
        ]


def _known(value: float | None) -> float:
    return float("nan") if value is None else float(value)


def main() -> None:
    """Entry point of the executable."""
    ros.run(StationRunner)

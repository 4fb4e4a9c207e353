"""``trajectory_sender``: sends a planned trajectory to a controller, and says whether the arm arrived."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from modcal_core.errors import BadCommand, BadTable
from modcal_core.files import read_yaml
from modcal_core.planning import Trajectory, trajectory_from_data
from modcal_msgs_py import JointInput, set_seconds
from modcal_nodes import ros

_PERIOD = 0.1  # s


class TrajectorySender(ros.HealthyNode):
    """Waits for joint states and for a controller, sends the trajectory once to ``~/joint_trajectory``, and ends."""

    executable = "trajectory_sender"

    def __init__(self) -> None:
        super().__init__()
        file = Path(self._chosen["trajectory"])
        if not file.is_file():
            raise BadTable(
                f"trajectory '{file}'", "is not a file", "set the parameter to the one that modcal plan wrote"
            )
        self._planned = trajectory_from_data(read_yaml(file), str(file))
        self._sent: Trajectory | None = None
        self._at = self._begun = time.monotonic()
        unlimited = np.full(len(self._planned.names), np.inf)
        self._joints = JointInput(self._planned.names, -unlimited, unlimited)
        self._trajectory = self.create_publisher(JointTrajectory, "~/joint_trajectory", 10)
        self._inputs = [self.hear(JointState, "joint_states", self._take_joints, ros.FRESH, needed=True, single=True)]
        self.every(_PERIOD, self._look)

    def _take_joints(self, message: JointState) -> None:
        self._joints.receive(message, self._now(), self._chosen["timeout_s"])

    def _look(self) -> None:
        """Send it as soon as the arm is known and somebody listens; end when it has arrived, or has not in time."""
        now, patience = time.monotonic(), self._chosen["patience_s"]
        if self._sent is None:
            if lacks := self._lacks():
                if now - self._begun > patience:
                    raise ros.NodeEnds(
                        BadCommand("trajectory", f"was not sent: {lacks}", "clear the cause, and start again")
                    )
                return
            try:
                self._send()
            except BadCommand as error:
                raise ros.NodeEnds(error) from error
            return
        off = np.abs(self._joints.position - self._sent.q[-1])
        if now - self._at < self._sent.t[-1]:
            return
        fresh = abs(self._now() - float(self._joints.stamps.min())) <= self._chosen["timeout_s"]
        if fresh and off.max() <= self._chosen["tolerance_rad"]:
            self.get_logger().info(f"arrived, {off.max():.2g} rad or m from the last point at most")
            raise SystemExit(0)
        if now - self._at > self._sent.t[-1] + patience:
            worst = int(np.argmax(off))
            said = f"{off[worst]:.3g} from the last point" if fresh else "is no longer received"
            raise ros.NodeEnds(BadCommand(f"joint {self._sent.names[worst]}", said, "check the controller's log"))

    def _lacks(self) -> str:
        if missing := self._joints.missing():
            return f"joint_states does not contain {', '.join(missing)}"
        if not abs(self._now() - float(self._joints.stamps.min())) <= self._chosen["timeout_s"]:
            return "joint_states: no message was received recently"
        if not self._trajectory.get_subscription_count():
            return f"no node subscribes to {self._trajectory.topic_name}: remap it to the controller's topic"
        return ""

    def _send(self) -> None:
        chosen = self._chosen
        ready = self._planned.led_up_to(self._joints.position, chosen["speed_rad_s"], chosen["approach_rad"])
        message = JointTrajectory(joint_names=list(ready.names))  # without a stamp: from now on
        for after, q in zip(ready.t, ready.q, strict=True):
            point = JointTrajectoryPoint(positions=q.tolist(), velocities=[0.0] * len(q))
            set_seconds(point.time_from_start, float(after))
            message.points.append(point)
        self._trajectory.publish(message)
        self._sent, self._at = ready, time.monotonic()
        self.get_logger().info(f"{len(ready.t)} points sent to {self._trajectory.topic_name}, {ready.t[-1]:.1f} s")

    def _report(self) -> list[ros.Status]:
        if self._sent is None:
            line = ros.Status("trajectory", ros.WARN, f"waiting: {self._lacks() or 'to send'}")
        else:
            line = ros.Status(
                "trajectory", ros.OK, f"sent, {time.monotonic() - self._at:.0f} of {self._sent.t[-1]:.0f} s ago"
            )
        return [ros.subscription_status(self._inputs, self._refusals), line]

"""``simulated_furniture``: an arm that holds the handle of a door or a drawer, in MuJoCo, at the clock's pace."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from modcal_core.errors import BadTable, ModcalError
from modcal_core.robots import read_chain
from modcal_msgs_py import fill_joints, fill_wrench
from modcal_nodes import ros, simulation

_LONGEST = 0.02  # s of wall time in one step of a simulated time, which waits where the machine does not keep up
_DEPTH = 100
_START = 1000.0  # s that a simulated time begins with
_AHEAD = 0.012  # s that a simulated time may run ahead of the last reference while it keeps step ...
_SILENCE = 1.0  # s ... and of wall time, after which nobody is thought to send any more
HANDLE = "handle"  # frame of the true grasp
# a servo goes where it was last sent: an older reference is of no use
_NEWEST = QoSProfile(depth=2, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE)


class SimulatedFurniture(simulation.SpeakingNode):
    """Publishes joint_states, wrench, robot_description and the truth; follows joint_references, joint_trajectory."""

    executable = "simulated_furniture"

    _at_once, _lost = 0.1, 5.0  # s of physics between two looks at what came in; that are not made up for

    def __init__(self) -> None:
        super().__init__()
        chosen = self._chosen
        file = Path(chosen["urdf"])
        if not file.is_file():
            raise BadTable(f"urdf '{file}'", "is not a file", "set the parameter urdf")
        text = file.read_text(encoding="utf-8")
        chain = read_chain(text, chosen["base"] or None, chosen["tip"] or None)
        scene = simulation.draw(chain, np.random.default_rng(chosen["seed"]), chosen)
        servo = simulation.Servo(
            simulation.effort_limits(text, chain.names), chosen["servo_stiffness"], chosen["servo_lag_s"]
        )
        noise = np.random.default_rng(chosen["seed"] + 1)
        self._world = simulation.Pulling.of(text, chain, scene, noise, servo, chosen["noise_n"], chosen["noise_nm"])
        if chosen["approach_s"] > 0.0:
            self._world.approach(chosen["approach_s"])
        self._refused = ""

        self._joints = self.create_publisher(JointState, "joint_states", _DEPTH)
        self._wrench = self.create_publisher(WrenchStamped, "wrench", _DEPTH)
        self._contact = self.create_publisher(WrenchStamped, "~/contact_force", _DEPTH)
        self._truth = self.create_publisher(JointState, "~/object_truth", _DEPTH)
        self._description = self.create_publisher(String, "robot_description", ros.LATCHED)
        self._description.publish(String(data=text))
        self.create_subscription(JointTrajectoryPoint, "joint_references", self._refer, _NEWEST)
        self.create_subscription(JointTrajectory, "joint_trajectory", self._follow, _NEWEST)
        goal = f"{np.degrees(scene.goal):.0f}°" if scene.turns else f"{100.0 * scene.goal:.0f} cm"
        self.get_logger().info(f"a {scene.kind} held by a {scene.grasp}: {goal} would be open")
        self._own = self._offset = 0.0
        self._referred = (-_SILENCE, 0.0)  # wall and own time of the last reference
        speakers = {
            "joint_states": (simulation.Grid(chosen["joint_rate_hz"]), self._send_joints),
            "wrench": (simulation.Grid(chosen["wrench_rate_hz"]), self._send_wrench),
            "truth": (simulation.Grid(chosen["truth_rate_hz"]), self._send_truth),
        }
        self._begin(speakers, _START, chosen["time_factor"], 0.0)

    def close(self) -> None:
        """Stand still, and say how far the object came."""
        super().close()
        self.get_logger().info(f"opened {self._world.opened:.4f}")

    def _own_time(self) -> float:
        """Seconds since it began: the clock's, or simulated ones, which wait for a machine that is busy."""
        if not self._simulated:
            return super()._own_time()
        wall = time.monotonic()
        own = self._own + min(wall - self._wall, _LONGEST) * self._factor
        if self._chosen["keep_step"] and wall - self._referred[0] < _SILENCE:
            own = max(self._own, min(own, self._referred[1] + _AHEAD))
        self._own, self._wall = own, wall
        return self._own

    def _jump(self, now: float) -> None:
        self._offset += now - self._done
        super()._jump(now)

    def _reach(self, t: float) -> int:
        """Let the world come up to a time [s]; returns its stamp [ns]."""
        self._world.advance(max(t - self._offset - self._world.time, 0.0))
        return self._stamp(t)

    def _say_time(self, t: float) -> None:
        self._reach(t)
        super()._say_time(t)

    def _refer(self, point: JointTrajectoryPoint) -> None:
        with self.lock:
            self._referred = time.monotonic(), self._done
            self._obey(lambda: self._world.refer(np.array(point.positions, dtype=float)))

    def _follow(self, trajectory: JointTrajectory) -> None:
        with self.lock:
            self._obey(lambda: self._world.follow(simulation.legs(self._world.chain, trajectory)))

    def _obey(self, act: Callable[[], None]) -> None:
        try:
            act()
            self._refused = ""
        except ModcalError as error:
            if error.limit != self._refused:
                self.get_logger().error(f"not followed: {error}")
            self._refused = error.limit

    def _send_joints(self, t: float) -> None:
        when = self._reach(t)
        efforts = self._world.efforts() if self._chosen["publish_effort"] else None
        self._joints.publish(fill_joints(JointState(), self._world.chain.names, when, *self._world.joints(), efforts))

    def _send_wrench(self, t: float) -> None:
        self._wrench.publish(fill_wrench(WrenchStamped(), self._world.chain.tip, self._reach(t), self._world.wrench()))

    def _send_truth(self, t: float) -> None:
        when = self._reach(t)
        self._contact.publish(fill_wrench(WrenchStamped(), HANDLE, when, self._world.peak()))
        self._world.forget()
        self._truth.publish(fill_joints(JointState(), self._world.object_joints, when, *self._world.object_state()))

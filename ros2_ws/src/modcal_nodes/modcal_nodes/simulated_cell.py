"""``simulated_cell``: an arm and a tracker to try things on. MuJoCo says where the tool is, not modcal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from modcal_core.errors import BadTable
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.urdf import read_chain
from modcal_nodes.parameters import SIMULATED_CELL, declare, values
from modcal_nodes.running import LATCHED, run
from modcal_nodes.simulation.program import Program, tour
from modcal_nodes.simulation.world import World


class SimulatedCell(Node):
    """Publishes joint_states, tracker/pose or tracker/point and robot_description; follows joint_trajectory."""

    def __init__(self) -> None:
        super().__init__("simulated_cell")
        declare(self, SIMULATED_CELL)
        chosen = values(self, SIMULATED_CELL)
        if chosen["measurement"] not in ("pose", "point"):
            raise BadTable(f"measurement '{chosen['measurement']}'", "pose and point are simulated", "set one of them")
        file = Path(chosen["urdf"])
        if not file.is_file():
            raise BadTable(f"urdf '{file}'", "is no file", "set the parameter urdf")
        text = file.read_text(encoding="utf-8")
        self._chosen = chosen
        self._gear = chosen["gear_joint"]
        self.chain = read_chain(text, chosen["base"] or None, chosen["tip"] or None)
        if self._gear and self._gear not in self.chain.names:
            raise BadTable(
                f"gear_joint '{self._gear}'", f"joints are {', '.join(self.chain.names)}", "name one of them"
            )
        rng = np.random.default_rng(chosen["seed"])
        self.world = make_world(self.chain, rng, chosen["length_std_m"], chosen["angle_std_rad"])
        self._noise = np.random.default_rng(chosen["seed"] + 1)
        self._program = Program(np.clip(np.zeros(self.chain.n), self.chain.lower, self.chain.upper))
        self._start = self.get_clock().now() + Duration(seconds=chosen["start_delay_s"])

        self._joints = self.create_publisher(JointState, "joint_states", 10)
        poses = chosen["measurement"] == "pose"
        kind, topic = (PoseStamped, "tracker/pose") if poses else (PointStamped, "tracker/point")
        self._tracker = self.create_publisher(kind, topic, 10)
        self._description = self.create_publisher(String, "robot_description", LATCHED)
        self._description.publish(String(data=text))
        self.create_subscription(JointTrajectory, "joint_trajectory", self._follow, 10)
        self.create_timer(1.0 / chosen["joint_rate_hz"], self._publish_joints)
        self.create_timer(1.0 / chosen["tracker_rate_hz"], self._publish_tracker)
        if chosen["stations"]:
            legs = tour(self.chain, chosen["stations"], chosen["travel_s"], chosen["dwell_s"], rng)
            self._program.reset(0.0, legs)
            self.get_logger().info(f"visiting {chosen['stations']} postures in {self._program.end:.0f} s")

    def _seconds(self, now: Time) -> float:
        """Time since the cell began to speak; below zero it is silent."""
        return 1e-9 * (now - self._start).nanoseconds

    def _publish_joints(self) -> None:
        now = self.get_clock().now()
        if self._seconds(now) < 0.0:
            return
        message = JointState(name=list(self.chain.names))
        message.header.stamp = now.to_msg()
        message.position = [float(x) for x in self._program.at(self._seconds(now))]
        self._joints.publish(message)

    def _publish_tracker(self) -> None:
        now = self.get_clock().now()
        if self._seconds(now) < 0.0:
            return
        T = self.world.tool_in_tracker(self._actual(self._program.at(self._seconds(now))))
        T[:3, 3] += self._chosen["noise_m"] * self._noise.standard_normal(3)
        T[:3, :3] = T[:3, :3] @ so3.exp(self._chosen["noise_rad"] * self._noise.standard_normal(3))
        x, y, z, *q = (float(v) for v in se3.to_pose(T))
        if self._chosen["measurement"] == "pose":
            message = PoseStamped()
            at, turn = message.pose.position, message.pose.orientation
            turn.x, turn.y, turn.z, turn.w = q
        else:
            message = PointStamped()
            at = message.point
        at.x, at.y, at.z = x, y, z
        message.header.stamp = now.to_msg()
        message.header.frame_id = "tracker"
        self._tracker.publish(message)

    def _actual(self, q: Array) -> Array:
        """Where the joints stand when they report q (n,)."""
        out = q.copy()
        if self._gear:
            j = self.chain.names.index(self._gear)
            out[j] += self._chosen["gear_amplitude_rad"] * np.sin(self._chosen["gear_cycles"] * q[j])
        return out

    def _follow(self, trajectory: JointTrajectory) -> None:
        """Go through the points of a trajectory from where the arm is, or refuse the whole of it."""
        names = tuple(trajectory.joint_names)
        if sorted(names) != sorted(self.chain.names):
            self.get_logger().error(
                f"joint_trajectory names {', '.join(names)}; this arm has {', '.join(self.chain.names)}"
            )
            return
        order = [names.index(name) for name in self.chain.names]
        now = self._seconds(self.get_clock().now())
        legs, last = [], 0.0
        for point in trajectory.points:
            after = point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec
            q = np.array(point.positions, dtype=float)
            if len(q) != len(order) or not np.isfinite(q).all() or after <= last:
                self.get_logger().error(
                    "joint_trajectory: a point has wrong positions, or times do not rise: not followed"
                )
                return
            q = q[order]
            if (q < self.chain.lower).any() or (q > self.chain.upper).any():
                self.get_logger().error("joint_trajectory: a point lies outside the joint limits: not followed")
                return
            legs.append((now + after, q))
            last = after
        if legs:
            self._program.reset(now, legs)


def make_world(chain: Chain, rng: np.random.Generator, length_std: float, angle_std: float) -> World:
    """The true cell of a seed: tracker a few metres away, tool a hand's length from the tip, bodies displaced."""
    T_tracker_base = se3.transform(so3.exp(rng.normal(size=3)), rng.uniform(-3.0, 3.0, 3))
    T_tip_tool = se3.transform(so3.exp(0.5 * rng.normal(size=3)), [0.06, -0.04, 0.15])
    return World(chain, rng, length_std, angle_std, T_tracker_base, T_tip_tool)


def main() -> None:
    """Entry point of the executable."""
    run(SimulatedCell)

"""``simulated_furniture``: an arm that holds the handle of a door or a drawer, in MuJoCo, at the clock's pace."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from modcal_core.errors import BadTable, ModcalError
from modcal_core.geometry import Array
from modcal_core.robots import read_chain
from modcal_nodes import ros, simulation

_MAX_AT_ONCE = 0.1  # s of physics between two looks at what came in
_LOST = 5.0  # s that are not made up for: the node's clock was set
_LONGEST = 0.02  # s of wall time in one step of a simulated time, which waits where the machine does not keep up
_DEPTH = 100
_START = 1000.0  # s that a simulated time begins with
_AHEAD = 0.012  # s that a simulated time may run ahead of the last reference while it keeps step ...
_SILENCE = 1.0  # s ... and of wall time, after which nobody is thought to send any more
HANDLE = "handle"  # frame of the true grasp
# a servo goes where it was last sent: an older reference is of no use
_NEWEST = QoSProfile(depth=2, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE)


class SimulatedFurniture(ros.GuardedNode):
    """Publishes joint_states, wrench, robot_description and the truth; follows joint_references, joint_trajectory."""

    def __init__(self) -> None:
        super().__init__("simulated_furniture")
        chosen = ros.declare(self, ros.SIMULATED_FURNITURE)
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
        self._refused, self._reports_effort = "", chosen["publish_effort"]

        self._joints = self.create_publisher(JointState, "joint_states", _DEPTH)
        self._wrench = self.create_publisher(WrenchStamped, "wrench", _DEPTH)
        self._contact = self.create_publisher(WrenchStamped, "~/contact_force", _DEPTH)
        self._truth = self.create_publisher(JointState, "~/object_truth", _DEPTH)
        self._description = self.create_publisher(String, "robot_description", ros.LATCHED)
        self._description.publish(String(data=text))
        self._states, self._truths = simulation.States(chain.names), simulation.States(self._world.object_joints)
        self._felt, self._grasp = WrenchStamped(), WrenchStamped()
        self._felt.header.frame_id, self._grasp.header.frame_id = chain.tip, HANDLE
        simulated, self._factor = chosen["publish_clock"], chosen["time_factor"]
        if simulated and self.get_parameter("use_sim_time").value:
            raise BadTable("publish_clock with use_sim_time", "it would wait for itself", "leave one of them out")
        self._clock_topic = self.create_publisher(ClockMessage, "/clock", _DEPTH) if simulated else None
        self._speakers: list[tuple[simulation.Grid, Callable[[tuple[int, int]], None]]] = [
            (simulation.Grid(chosen["joint_rate_hz"]), self._send_joints),
            (
                simulation.Grid(chosen["wrench_rate_hz"]),
                lambda when: self._wrench.publish(_filled(self._felt, when, self._world.wrench())),
            ),
            (simulation.Grid(chosen["truth_rate_hz"]), self._send_truth),
        ]
        self._rates = simulation.Rates({"joint_states": self._speakers[0][0], "wrench": self._speakers[1][0]}, 1.0)
        if simulated:
            self._speakers.insert(0, (simulation.Grid(chosen["clock_rate_hz"]), self._send_clock))
        self._time, self._begun, self._done, self._offset = (
            simulation.CellTime(self, 0.0, simulated, _START),
            False,
            0.0,
            0.0,
        )
        self._wall, self._own = time.monotonic(), 0.0
        self._keeps_step = bool(simulated and chosen["keep_step"])
        self._referred = (-_SILENCE, 0.0)  # wall and own time of the last reference
        ros.Health(self, lambda: [self._rates.status()])
        fastest = max(chosen["joint_rate_hz"], chosen["wrench_rate_hz"])
        self._beat = simulation.Beat(
            1.0 / (fastest * (self._factor if simulated else 1.0)), self.guarded("beat", self._go_on), self.context.ok
        )
        self.create_subscription(JointTrajectoryPoint, "joint_references", self._refer, _NEWEST)
        self.create_subscription(JointTrajectory, "joint_trajectory", self._follow, _NEWEST)
        goal = f"{np.degrees(scene.goal):.0f}°" if scene.turns else f"{100.0 * scene.goal:.0f} cm"
        self.get_logger().info(f"a {scene.kind} held by a {scene.grasp}: {goal} would be open")
        self._beat.start()

    def close(self) -> None:
        """Stand still, and say how far the object came."""
        self._beat.stop()
        self.get_logger().info(f"opened {self._world.opened:.4f}")

    def _now(self) -> float:
        """Seconds since it began: the clock's, or simulated ones, which wait for a machine that is busy."""
        if self._clock_topic is None:
            return self._time.now()
        wall = time.monotonic()
        own = self._own + min(wall - self._wall, _LONGEST) * self._factor
        if self._keeps_step and wall - self._referred[0] < _SILENCE:
            own = max(self._own, min(own, self._referred[1] + _AHEAD))
        self._own, self._wall = own, wall
        return self._own

    def _go_on(self) -> None:
        """Let the world come up to the clock, and say what falls due on the way."""
        if not self._begun:
            self._begun = self._time.begin()
            return
        now = self._now()
        if not -_LOST < now - self._done < _LOST:
            self.get_logger().warning(f"the clock jumped by {now - self._done:.3f} s: continuing from there")
            self._offset += now - self._done
            self._done = now
            for grid, _ in self._speakers:
                grid.start(now)
        self._rates.note(now - self._done)
        until = min(now, self._done + _MAX_AT_ONCE)
        due = [(t, speak) for grid, speak in self._speakers for t in grid.take(until)]
        for t, speak in sorted(due, key=lambda one: one[0]):
            self._world.advance(max(t - self._offset - self._world.time, 0.0))
            speak(self._time.stamp(t))
        self._done = max(until, self._done)

    def _refer(self, point: JointTrajectoryPoint) -> None:
        with self._beat.lock:
            self._referred = time.monotonic(), self._done
            self._obey(lambda: self._world.refer(np.array(point.positions, dtype=float)))

    def _follow(self, trajectory: JointTrajectory) -> None:
        with self._beat.lock:
            self._obey(lambda: self._world.follow(simulation.legs(self._world.chain, trajectory)))

    def _obey(self, act: Callable[[], None]) -> None:
        try:
            act()
            self._refused = ""
        except ModcalError as error:
            if error.limit != self._refused:
                self.get_logger().error(f"not followed: {error}")
            self._refused = error.limit

    def _send_clock(self, when: tuple[int, int]) -> None:
        assert self._clock_topic is not None
        message = ClockMessage()
        message.clock.sec, message.clock.nanosec = when
        self._clock_topic.publish(message)

    def _send_joints(self, when: tuple[int, int]) -> None:
        q, v = self._world.joints()
        self._joints.publish(self._states.fill(when, q, v, self._world.efforts() if self._reports_effort else None))

    def _send_truth(self, when: tuple[int, int]) -> None:
        self._contact.publish(_filled(self._grasp, when, self._world.peak()))
        self._world.forget()
        self._truth.publish(self._truths.fill(when, *self._world.object_state(), None))


def _filled(message: WrenchStamped, when: tuple[int, int], wrench: Array) -> WrenchStamped:
    simulation.stamp(message, when)
    force, torque = message.wrench.force, message.wrench.torque
    force.x, force.y, force.z, torque.x, torque.y, torque.z = wrench.tolist()
    return message


def main() -> None:
    """Entry point of the executable."""
    ros.run(SimulatedFurniture)

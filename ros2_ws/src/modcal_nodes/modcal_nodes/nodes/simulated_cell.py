"""``simulated_cell``: an arm or a Delta, and a tracker, to try things on. MuJoCo says where the tool is, not modcal."""

from __future__ import annotations

from typing import Any

import numpy as np
from geometry_msgs.msg import PointStamped, PoseStamped
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from modcal_core.errors import BadTable, ModcalError
from modcal_msgs_py import fill_joints, fill_posed, set_nanoseconds
from modcal_nodes import ros, simulation

_DEPTH = 2000  # messages a publisher keeps for a subscriber that is behind


class SimulatedCell(simulation.SpeakingNode):
    """Publishes joint_states, tracker/pose or tracker/point and robot_description; follows joint_trajectory."""

    executable = "simulated_cell"

    _plant: simulation.Plant

    def __init__(self) -> None:
        super().__init__()
        chosen = self._chosen
        self._plant = plant = simulation.Plant(chosen)
        points = chosen["measurement"] == "point"
        kind, topic = (PointStamped, "tracker/point") if points else (PoseStamped, "tracker/pose")
        self._joints = self.create_publisher(JointState, "joint_states", _DEPTH)
        self._tracker = self.create_publisher(kind, topic, _DEPTH)
        self._true = self.create_publisher(PoseStamped, "~/true_tool", _DEPTH)
        self._true_in_base = self.create_publisher(PoseStamped, "~/true_tool_in_base", _DEPTH)
        self._temperature = self.create_publisher(Temperature, "temperature", 10)
        self._description = self.create_publisher(String, "robot_description", ros.LATCHED)
        if plant.text:
            self._description.publish(String(data=plant.text))
        self._kind = kind
        self.create_subscription(JointTrajectory, "joint_trajectory", self._follow, 10)
        self.offer("~/restart", self._restart)
        if chosen["stations"]:
            self.get_logger().info(f"visiting {plant.stops} postures in {plant.end:.0f} s")
        fast, slow = chosen["joint_rate_hz"], chosen["tracker_rate_hz"]
        speakers = {
            "joint_states": (simulation.Grid(fast), self._send_joints),
            "tracker": (simulation.Grid(slow, simulation.TRACKER_PHASE * slow / fast), self._send_reading),
            "temperature": (simulation.Grid(1.0), self._send_temperature),
        }
        self._begin(speakers, chosen["clock_start_s"], chosen["time_factor"], chosen["start_delay_s"])

    def close(self) -> None:
        """Fall silent, and say how much was said."""
        super().close()
        said = {"joint_states": self._joints, "tracker": self._tracker}
        counts = (f"{self._grids[name].count} {publisher.topic_name}" for name, publisher in said.items())
        self.get_logger().info("published " + ", ".join(counts))

    def _ready(self) -> bool:
        least = self._chosen["min_subscribers"]
        return all(topic.get_subscription_count() >= least for topic in (self._joints, self._tracker))

    def _advance(self, until: float) -> None:
        self._plant.keep_going(self._done, until)

    def _jump(self, now: float) -> None:
        """Go on at another time, the arm as it is; postures of its own restart when time moves backwards."""
        self._plant.jump(self._done, now)
        super()._jump(now)

    def _restart(self) -> tuple[bool, str]:
        if not self._simulated:
            return False, "the cell does not publish its own clock: start it with publish_clock"
        with self.lock:
            self._start_time()
            self._jump(-self._delay)
        self.get_logger().info("time has restarted")
        return True, "time has restarted"

    def _follow(self, trajectory: JointTrajectory) -> None:
        try:
            wanted = simulation.legs(self._plant.chain, trajectory, self._plant.posture(self._done))
        except ModcalError as error:
            self.get_logger().error(f"not followed: {error}")
            return
        if wanted:
            with self.lock:
                self._plant.go(wanted, self._done)

    def _send_joints(self, t: float) -> None:
        self._joints.publish(fill_joints(JointState(), self._plant.chain.names, self._stamp(t), *self._plant.joints(t)))

    def _send_reading(self, t: float) -> None:
        when, T_base_tool, tracker = self._stamp(t), self._plant.tool(t), simulation.TRACKER
        if self._true.get_subscription_count():
            T_tracker_tool = self._plant.world.T_tracker_base @ T_base_tool
            self._true.publish(fill_posed(PoseStamped(), tracker, when, T_tracker_tool))
        if self._true_in_base.get_subscription_count():
            self._true_in_base.publish(fill_posed(PoseStamped(), self._plant.chain.base, when, T_base_tool))
        self._tracker.publish(fill_posed(self._kind(), tracker, when, self._plant.read(T_base_tool)))

    def _send_temperature(self, t: float) -> None:
        if (felt := self._plant.temperature(t)) is None:
            return
        message = Temperature(temperature=felt[1])
        message.header.frame_id = felt[0]
        set_nanoseconds(message.header.stamp, self._stamp(t))
        self._temperature.publish(message)

    def _check(self, new: dict[str, Any]) -> None:
        """Raises BadTable for switches that cannot be set so."""
        if not hasattr(self, "_plant"):
            return  # which looks at all of them itself
        wanted = {name: new[name] for name in simulation.SWITCHES}
        if (reason := self._plant.switches.refusal(wanted)) is not None:
            self.get_logger().warning(f"parameters refused: {reason}")
            raise BadTable("simulated cell", reason, "set another value")

    def _take_parameters(self) -> None:
        switches = self._plant.switches
        for name in simulation.SWITCHES:
            before, wanted = switches.value(name), self._chosen[name]
            if not np.array_equal(before, wanted):
                with self.lock:
                    switches.set(name, wanted, self._done)
                self.get_logger().info(
                    f"{name}: {before} -> {switches.value(name)}, {self._done:.3f} s after the start"
                )

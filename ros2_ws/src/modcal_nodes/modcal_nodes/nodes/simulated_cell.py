"""``simulated_cell``: an arm or a Delta, and a tracker, to try things on. MuJoCo says where the tool is, not modcal."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import PointStamped, PoseStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from modcal_core.errors import BadTable, ModcalError
from modcal_nodes import ros, simulation

_MIN_PERIOD = 1e-3  # s between beats; what falls due in between is sent together
_MAX_AT_ONCE = 0.2  # s of wall time that one beat makes up for, so that services are answered in between
_LOST = 10.0  # s that are not made up for: the node's clock was set
_DEPTH = 2000  # messages a publisher keeps for a subscriber that is behind


class SimulatedCell(ros.GuardedNode):
    """Publishes joint_states, tracker/pose or tracker/point and robot_description; follows joint_trajectory."""

    def __init__(self) -> None:
        super().__init__("simulated_cell")
        chosen = ros.declare(self, ros.SIMULATED_CELL)
        self._plant = simulation.Plant(chosen)
        self._switches = self._plant.switches
        self._speak(chosen)
        if chosen["stations"]:
            self.get_logger().info(f"visiting {self._plant.stops} postures in {self._plant.end:.0f} s")
        # from here on the switches may be changed, to values that make sense
        self.add_on_set_parameters_callback(self._judge)
        self.add_post_set_parameters_callback(self._take)
        self._beat.start()

    def close(self) -> None:
        """Fall silent, and say how much was said."""
        self._beat.stop()
        counts = {self._joints.topic_name: self._joint_grid.count, self._tracker.topic_name: self._tracker_grid.count}
        self.get_logger().info("published " + ", ".join(f"{count} {topic}" for topic, count in counts.items()))

    def _speak(self, chosen: dict[str, Any]) -> None:
        text, chain = self._plant.text, self._plant.chain
        simulated, factor = chosen["publish_clock"], chosen["time_factor"] if chosen["publish_clock"] else 1.0
        if simulated and self.get_parameter("use_sim_time").value:
            raise BadTable("publish_clock with use_sim_time", "the cell would wait for itself", "leave one of them out")
        self._time = simulation.CellTime(self, chosen["start_delay_s"], simulated, chosen["clock_start_s"], factor)
        self._begun, self._done, self._factor = False, -chosen["start_delay_s"], factor
        self._least = chosen["min_subscribers"]
        fast, slow = chosen["joint_rate_hz"], chosen["tracker_rate_hz"]
        self._joint_grid, self._tracker_grid = (
            simulation.Grid(fast),
            simulation.Grid(slow, simulation.TRACKER_PHASE * slow / fast),
        )
        self._clock_grid, self._temperature_grid = simulation.Grid(chosen["clock_rate_hz"]), simulation.Grid(1.0)
        self._clock_grid.start(self._done)
        self._rates = simulation.Rates({"joint_states": self._joint_grid, "tracker": self._tracker_grid}, factor)

        points = chosen["measurement"] == "point"
        kind, topic = (PointStamped, "tracker/point") if points else (PoseStamped, "tracker/pose")
        self._joints = self.create_publisher(JointState, "joint_states", _DEPTH)
        self._tracker = self.create_publisher(kind, topic, _DEPTH)
        self._true = self.create_publisher(PoseStamped, "~/true_tool", _DEPTH)
        self._true_in_base = self.create_publisher(PoseStamped, "~/true_tool_in_base", _DEPTH)
        self._temperature = self.create_publisher(Temperature, "temperature", 10)
        self._time_topic = self.create_publisher(ClockMessage, "/clock", _DEPTH) if simulated else None
        self._description = self.create_publisher(String, "robot_description", ros.LATCHED)
        if text:
            self._description.publish(String(data=text))
        self._states, self._readings = simulation.States(chain.names), simulation.Poses(simulation.TRACKER, points)
        self._truths, self._truths_in_base = simulation.Poses(simulation.TRACKER), simulation.Poses(chain.base)
        self.create_subscription(JointTrajectory, "joint_trajectory", self._follow, 10)
        self.offer("~/restart", self._restart)
        ros.Health(self, lambda: [self._rates.status()])
        period = max(_MIN_PERIOD, 1.0 / (max(fast, slow) * factor))
        self._beat = simulation.Beat(period, self.guarded("beat", self._send_due), self.context.ok)

    def _send_due(self) -> None:
        """Send what a busy machine held up as well, late and with the stamps that it should have had."""
        if not self._begun:
            heard = all(t.get_subscription_count() >= self._least for t in (self._joints, self._tracker))
            self._begun = heard and self._time.begin()
            if not self._begun:
                return
        now = self._time.now()
        behind = now - self._done
        if behind < 0.0 or behind > _LOST * self._factor:
            self.get_logger().warning(f"the clock jumped by {behind:.3f} s: continuing from there")
            self._jump(now)
        self._rates.note(now - self._done)
        until = min(now, self._done + _MAX_AT_ONCE * self._factor)
        if self._time_topic is not None:
            for t in self._clock_grid.take(until):
                message = ClockMessage()
                message.clock.sec, message.clock.nanosec = self._time.stamp(t)
                self._time_topic.publish(message)
        self._plant.keep_going(self._done, until)
        for t in self._joint_grid.take(until):
            self._joints.publish(self._states.fill(self._time.stamp(t), *self._plant.joints(t)))
        for t in self._tracker_grid.take(until):
            self._send_reading(t)
        for t in self._temperature_grid.take(until):
            self._send_temperature(t)
        self._done = until

    def _jump(self, now: float) -> None:
        """Go on at another time, the arm as it is; postures of its own restart when time moves backwards."""
        self._plant.jump(self._done, now)
        for grid in (self._joint_grid, self._tracker_grid, self._temperature_grid, self._clock_grid):
            grid.start(now)
        self._done = now

    def _restart(self) -> tuple[bool, str]:
        if not self._time.simulated:
            return False, "the cell does not publish its own clock: start it with publish_clock"
        with self._beat.lock:
            self._time.begin()
            self._jump(-self._time.delay)
        self.get_logger().info("time has restarted")
        return True, "time has restarted"

    def _follow(self, trajectory: JointTrajectory) -> None:
        try:
            wanted = simulation.legs(self._plant.chain, trajectory, self._plant.posture(self._done))
        except ModcalError as error:
            self.get_logger().error(f"not followed: {error}")
            return
        if wanted:
            with self._beat.lock:
                self._plant.go(wanted, self._done)

    def _send_reading(self, t: float) -> None:
        when, T_base_tool = self._time.stamp(t), self._plant.tool(t)
        if self._true.get_subscription_count():
            T_tracker_base = self._plant.world.T_tracker_base
            self._true.publish(self._truths.fill(when, T_tracker_base @ T_base_tool))
        if self._true_in_base.get_subscription_count():
            self._true_in_base.publish(self._truths_in_base.fill(when, T_base_tool))
        self._tracker.publish(self._readings.fill(when, self._plant.read(T_base_tool)))

    def _send_temperature(self, t: float) -> None:
        if (felt := self._plant.temperature(t)) is None:
            return
        message = Temperature(temperature=felt[1])
        message.header.frame_id = felt[0]
        simulation.stamp(message, self._time.stamp(t))
        self._temperature.publish(message)

    def _judge(self, parameters: list[Parameter]) -> SetParametersResult:
        wanted = {p.name: p.value for p in parameters if p.name in simulation.SWITCHES}
        reason = self._switches.refusal(wanted)
        if reason is not None:
            self.get_logger().warning(f"{', '.join(wanted)} refused: {reason}")
        return SetParametersResult(successful=reason is None, reason=reason or "")

    def _take(self, parameters: list[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name in simulation.SWITCHES:
                before = self._switches.value(parameter.name)
                with self._beat.lock:
                    self._switches.set(parameter.name, parameter.value, self._done)
                after = self._switches.value(parameter.name)
                self.get_logger().info(f"{parameter.name}: {before} -> {after}, {self._done:.3f} s after the start")


def main() -> None:
    """Entry point of the executable."""
    ros.run(SimulatedCell)

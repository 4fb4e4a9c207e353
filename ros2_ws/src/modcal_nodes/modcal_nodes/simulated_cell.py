"""``simulated_cell``: an arm or a Delta, and a tracker, to try things on. MuJoCo says where the tool is, not modcal."""

from __future__ import annotations

from copy import copy
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PointStamped, PoseStamped
from numpy.typing import ArrayLike
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from modcal_core.errors import BadTable, ModcalError
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.mechanism import Mechanism
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import Inertias, read_inertias
from modcal_nodes.health import Health
from modcal_nodes.inputs import read_delta
from modcal_nodes.parameters import SIMULATED_CELL, declare, values
from modcal_nodes.running import LATCHED, run
from modcal_nodes.simulation.commands import legs
from modcal_nodes.simulation.delta_world import make_delta_world, require_drivable
from modcal_nodes.simulation.machine import Machine, tracker_and_tool
from modcal_nodes.simulation.pace import Beat, CellTime, Grid
from modcal_nodes.simulation.program import Program, tour
from modcal_nodes.simulation.rates import Rates
from modcal_nodes.simulation.spoken import TRACKER, Poses, States, stamp
from modcal_nodes.simulation.switches import SWITCHES, Switches
from modcal_nodes.simulation.world import World

_LOOK_AFTER = 0.2  # s
_LEAST_PERIOD = 1e-3  # s between beats; what falls due in between is sent together
_MOST_AT_ONCE = 0.2  # s of wall time that one beat makes up for, so that services are answered in between
_LOST = 10.0  # s that are not made up for: the node's clock was set
_DEPTH = 2000  # messages a publisher keeps for a subscriber that is behind
_AWAY = 0.02  # rad or m; a nearer posture is the same arrival
_TRACKER_PHASE = 2.0**0.5 - 1.0  # of a joint state's period: the same stamp would say that this is a finished station


class SimulatedCell(Node):
    """Publishes joint_states, tracker/pose or tracker/point and robot_description; follows joint_trajectory."""

    def __init__(self) -> None:
        super().__init__("simulated_cell")
        declare(self, SIMULATED_CELL)
        chosen = values(self, SIMULATED_CELL)
        text, self.chain = _arm(chosen)
        rng = np.random.default_rng(chosen["seed"])
        compliance = _compliance(chosen["joint_compliance_rad_per_nm"], self.chain)
        off = chosen["length_std_m"], chosen["angle_std_rad"]
        self.world: Machine = (
            make_world(self.chain, rng, *off, read_inertias(text, self.chain), compliance)
            if isinstance(self.chain, Chain)
            else make_delta_world(self.chain, rng, *off, compliance)
        )
        self._chosen, self._rng = chosen, rng
        self._noise = np.random.default_rng(chosen["seed"] + 1)
        self._arrivals = np.random.default_rng(chosen["seed"] + 2)
        self._gear = self.chain.names.index(chosen["gear_joint"]) if chosen["gear_joint"] else None
        self._program = Program(np.clip(np.zeros(self.chain.n), self.chain.lower, self.chain.upper))
        self._miss = Program(np.zeros(self.chain.n))
        self._own: list[tuple[float, Array]] = []
        self._repeat = False
        self._switches = Switches(self.world, chosen)
        self._speak(chosen, text)
        if chosen["stations"]:
            self._own = tour(self.chain, chosen["stations"], chosen["travel_s"], chosen["dwell_s"], rng)
            self._begin_own(0.0)
            self.get_logger().info(f"visiting {chosen['stations']} postures in {self._program.end:.0f} s")
        self._settle_parameters()
        self._beat.start()

    def close(self) -> None:
        """Fall silent, and say how much was said."""
        self._beat.stop()
        counts = {self._joints.topic_name: self._joint_grid.count, self._tracker.topic_name: self._tracker_grid.count}
        self.get_logger().info("published " + ", ".join(f"{count} {topic}" for topic, count in counts.items()))

    def _speak(self, chosen: dict[str, Any], text: str) -> None:
        """Open every topic, service and timer."""
        simulated, factor = chosen["publish_clock"], chosen["time_factor"] if chosen["publish_clock"] else 1.0
        if simulated and self.get_parameter("use_sim_time").value:
            raise BadTable("publish_clock with use_sim_time", "the cell would wait for itself", "leave one of them out")
        self._time = CellTime(self, chosen["start_delay_s"], simulated, chosen["clock_start_s"], factor)
        self._begun, self._done, self._factor = False, -chosen["start_delay_s"], factor
        fast, slow = chosen["joint_rate_hz"], chosen["tracker_rate_hz"]
        self._joint_grid, self._tracker_grid = Grid(fast), Grid(slow, _TRACKER_PHASE * slow / fast)
        self._clock_grid, self._temperature_grid = Grid(chosen["clock_rate_hz"]), Grid(1.0)
        self._clock_grid.start(self._done)
        self._rates = Rates({"joint_states": self._joint_grid, "tracker": self._tracker_grid}, factor)

        points = chosen["measurement"] == "point"
        kind, topic = (PointStamped, "tracker/point") if points else (PoseStamped, "tracker/pose")
        self._joints = self.create_publisher(JointState, "joint_states", _DEPTH)
        self._tracker = self.create_publisher(kind, topic, _DEPTH)
        self._true = self.create_publisher(PoseStamped, "~/true_tool", _DEPTH)
        self._true_in_base = self.create_publisher(PoseStamped, "~/true_tool_in_base", _DEPTH)
        self._temperature = self.create_publisher(Temperature, "temperature", 10)
        self._time_topic = self.create_publisher(ClockMessage, "/clock", _DEPTH) if simulated else None
        self._description = self.create_publisher(String, "robot_description", LATCHED)
        if text:
            self._description.publish(String(data=text))
        self._states, self._readings = States(self.chain.names), Poses(TRACKER, points)
        self._truths, self._truths_in_base = Poses(TRACKER), Poses(self.chain.base)
        self.create_subscription(JointTrajectory, "joint_trajectory", self._follow, 10)
        self.create_service(Trigger, "~/restart", self._restart)
        Health(self, lambda: [self._rates.status()])
        period = max(_LEAST_PERIOD, 1.0 / (max(fast, slow) * factor))
        self._beat = Beat(period, self._send_due)
        self.create_timer(_LOOK_AFTER, self._look_after_beat, clock=Clock(clock_type=ClockType.STEADY_TIME))

    # time

    def _look_after_beat(self) -> None:
        if self._beat.failure is not None and self.context.ok():
            raise self._beat.failure

    def _send_due(self) -> None:
        """Send what a busy machine held up as well, late and with the stamps that it should have had."""
        if not self._begun:
            self._begun = self._time.begin()
            if not self._begun:
                return
        now = self._time.now()
        behind = now - self._done
        if behind < 0.0 or behind > _LOST * self._factor:
            self.get_logger().warning(f"the clock jumped by {behind:.3f} s: going on from there")
            self._jump(now)
        self._rates.note(now - self._done)
        until = min(now, self._done + _MOST_AT_ONCE * self._factor)
        if self._time_topic is not None:
            for t in self._clock_grid.take(until):
                message = ClockMessage()
                message.clock.sec, message.clock.nanosec = self._time.stamp(t)
                self._time_topic.publish(message)
        while self._repeat and until > self._program.end - self._chosen["travel_s"]:
            self._go_on()
        for t in self._joint_grid.take(until):
            self._send_joints(t)
        for t in self._tracker_grid.take(until):
            self._send_reading(t)
        for t in self._temperature_grid.take(until):
            self._send_temperature(t)
        self._done = until

    def _jump(self, now: float) -> None:
        """Go on at another time, the arm as it is; postures of its own begin anew when time went back."""
        back = now < self._done
        here, missed = self._program.at(self._done), self._miss.at(self._done)
        if back:
            self._program, self._miss = Program(here), Program(missed)
        self._switches.rebase(self._done, now)
        for grid in (self._joint_grid, self._tracker_grid, self._temperature_grid, self._clock_grid):
            grid.start(now)
        self._done = now
        if back and self._own:
            self._begin_own(now)

    def _restart(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        if not self._time.simulated:
            answer.message = "the cell's time is not its own: start it with publish_clock"
            return answer
        with self._beat.lock:
            self._time.begin()
            self._jump(-self._time.delay)
        answer.success, answer.message = True, "time began anew"
        self.get_logger().info(answer.message)
        return answer

    # the arm

    def _begin_own(self, start: float) -> None:
        self._repeat = self._chosen["repeat"]
        self._go([(start + after, q) for after, q in self._own], start)

    def _go(self, legs: list[tuple[float, Array]], start: float) -> None:
        self._miss.reset(start, self._missed(legs, self._program.at(start), self._miss.at(start)))
        self._program.reset(start, legs)

    def _go_on(self) -> None:
        """Append another tour to the one that ends."""
        end, last = self._program.end, self._miss.at(self._program.end)
        chosen = self._chosen
        more = tour(self.chain, chosen["stations"], chosen["travel_s"], chosen["dwell_s"], self._rng)
        legs = [(end + after, q) for after, q in more]
        self._miss.extend(self._missed(legs, self._program.at(end), last), self._done)
        self._program.extend(legs, self._done)

    def _missed(self, legs: list[tuple[float, Array]], q: Array, miss: Array) -> list[tuple[float, Array]]:
        """By how much each posture is missed (n,): anew wherever the arm arrives."""
        out = []
        for at, goal in legs:
            if np.abs(goal - q).max() > _AWAY:
                q, miss = goal, self._chosen["repeatability_rad"] * self._arrivals.standard_normal(self.chain.n)
            out.append((at, miss))
        return out

    def _sent_to(self, t: float) -> Array:
        """Where motors and gears bring the joints (n,) at a time, before springs give way."""
        reported = self._program.at(t)
        q = reported + self._miss.at(t)
        if (j := self._gear) is not None:
            q[j] += self._chosen["gear_amplitude_rad"] * np.sin(self._chosen["gear_cycles"] * reported[j])
        return q

    def _follow(self, trajectory: JointTrajectory) -> None:
        """Go through the points of a trajectory from where the arm is, or refuse the whole of it."""
        try:
            wanted = legs(self.chain, trajectory, self._program.at(self._done))
        except ModcalError as error:
            self.get_logger().error(f"not followed: {error}")
            return
        if wanted:
            with self._beat.lock:
                self._repeat, self._own = False, []
                self._go([(self._done + after, q) for after, q in wanted], self._done)

    # what it says

    def _send_joints(self, t: float) -> None:
        q, v = self._program.state(t)
        effort = None
        if self._chosen["publish_effort"]:
            self._switches.pass_to(t)
            effort = self.world.holding(self._sent_to(t))
        self._joints.publish(self._states.fill(self._time.stamp(t), q, v, effort))

    def _send_reading(self, t: float) -> None:
        self._switches.pass_to(t)
        when, T_base_tool = self._time.stamp(t), self.world.tool_in_base(self._sent_to(t))
        T = self.world.T_tracker_base @ T_base_tool
        if self._true.get_subscription_count():
            self._true.publish(self._truths.fill(when, T))
        if self._true_in_base.get_subscription_count():
            self._true_in_base.publish(self._truths_in_base.fill(when, T_base_tool))
        T[:3, 3] += self._chosen["noise_m"] * self._noise.standard_normal(3)
        T[:3, :3] = T[:3, :3] @ so3.exp(self._chosen["noise_rad"] * self._noise.standard_normal(3))
        self._tracker.publish(self._readings.fill(when, T))

    def _send_temperature(self, t: float) -> None:
        if (felt := self._switches.temperature(t)) is None:
            return
        message = Temperature(temperature=felt[1] + self._chosen["temperature_noise_k"] * self._noise.standard_normal())
        message.header.frame_id = felt[0]
        stamp(message, self._time.stamp(t))
        self._temperature.publish(message)

    # parameters

    def _settle_parameters(self) -> None:
        """From here on only the switches may be changed, and only to values that make sense."""
        for name in SIMULATED_CELL.keys() - set(SWITCHES):
            descriptor = copy(self.describe_parameter(name))  # rclpy hands out its own
            descriptor.read_only = True
            self.set_descriptor(name, descriptor)
        self.add_on_set_parameters_callback(self._judge)
        self.add_post_set_parameters_callback(self._take)

    def _judge(self, parameters: list[Parameter]) -> SetParametersResult:
        wanted = {p.name: p.value for p in parameters if p.name in SWITCHES}
        reason = self._switches.refusal(wanted)
        if reason is not None:
            self.get_logger().warning(f"{', '.join(wanted)} refused: {reason}")
        return SetParametersResult(successful=reason is None, reason=reason or "")

    def _take(self, parameters: list[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name in SWITCHES:
                before = self._switches.value(parameter.name)
                with self._beat.lock:
                    self._switches.set(parameter.name, parameter.value, self._done)
                after = self._switches.value(parameter.name)
                self.get_logger().info(f"{parameter.name}: {before} -> {after}, {self._done:.3f} s after the start")


def _arm(chosen: dict[str, Any]) -> tuple[str, Mechanism]:
    """The URDF's text, empty for a Delta, and the robot. Raises ModcalError for choices that cannot be."""
    if chosen["measurement"] not in ("pose", "point"):
        raise BadTable(f"measurement '{chosen['measurement']}'", "pose and point are simulated", "set one of them")
    kind = "delta" if chosen["delta"] else "urdf"
    file = Path(chosen[kind])
    if not file.is_file():
        raise BadTable(f"{kind} '{file}'", "is no file", f"set the parameter {kind}")
    chain: Mechanism
    if chosen["delta"]:
        text, chain = "", read_delta(file)
        require_drivable(chain)
    else:
        text = file.read_text(encoding="utf-8")
        chain = read_chain(text, chosen["base"] or None, chosen["tip"] or None)
    if chosen["gear_joint"] and chosen["gear_joint"] not in chain.names:
        said = f"joints are {', '.join(chain.names)}"
        raise BadTable(f"gear_joint '{chosen['gear_joint']}'", said, "name one of them")
    return text, chain


def _compliance(given: ArrayLike, chain: Mechanism) -> Array:
    """Compliance of every joint (n,) from one number for all, or one a joint."""
    compliance = np.asarray(given, dtype=float)
    if len(compliance) not in (1, chain.n) or not ((compliance >= 0.0) & (compliance <= 1e-3)).all():
        said = f"1 or {chain.n} numbers from 0 to 0.001 are understood"
        raise BadTable(f"joint_compliance_rad_per_nm {compliance.tolist()}", said, "set as many")
    return np.broadcast_to(compliance, (chain.n,))


def make_world(
    chain: Chain,
    rng: np.random.Generator,
    length_std: float,
    angle_std: float,
    inertias: Inertias | None = None,
    compliance: ArrayLike = 0.0,
) -> World:
    """The true cell of a seed: tracker a few metres away, tool a hand's length from the tip, bodies displaced."""
    T_tracker_base, T_tip_tool = tracker_and_tool(rng)
    return World(chain, rng, length_std, angle_std, T_tracker_base, T_tip_tool, inertias, compliance)


def main() -> None:
    """Entry point of the executable."""
    run(SimulatedCell)

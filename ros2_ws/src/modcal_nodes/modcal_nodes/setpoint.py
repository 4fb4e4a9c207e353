"""What ``impedance_setpoint`` is made of: arm and task by its parameters, what it hears, and how it says what to do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from modcal_core.errors import BadCommand, BadRobot, BadTable
from modcal_core.geometry import Array, se3
from modcal_core.impedance import (
    ArmEfforts,
    ArmSetpoint,
    FreeMotion,
    GovernorSettings,
    ImpedanceTask,
    JointPositions,
    Limits,
    Load,
    Operation,
    WrenchSensor,
)
from modcal_core.robots import Chain, chain_forward, pose_and_jacobian, read_chain, read_drives, read_inertias
from modcal_msgs_py import (
    JointInput,
    desired_pose,
    fill_point,
    fill_posed,
    fill_wrench,
    seconds,
    set_seconds,
    wrench_numbers,
)

_SLOWS, _STANDS = 0.6, 0.95  # of the most force: what needs less than that is opened
_LEAD, _LEAD_SHARE = 0.08, 1.3  # m by which the expected pose may lead; of what the most force takes of the impedance


@dataclass(frozen=True)
class SensedArm:
    """The chain to the tool, and its force sensor. farthest: no tool lies farther off [m]."""

    urdf: str
    chain: Chain
    sensor: WrenchSensor
    farthest: float

    @classmethod
    def of(cls, urdf: str, chosen: dict[str, Any]) -> SensedArm:
        """The arm of a URDF. Raises BadRobot."""
        chain = read_chain(urdf, chosen["base"] or None, chosen["tip"] or None)
        frames = [(chain.tip, np.eye(4))]
        if chosen["wrench_frame"]:
            frames.append((chosen["wrench_frame"], _fixed(urdf, chain, chosen["wrench_frame"])))
        load = Load(chosen["tool_mass"], _numbers("tool_centre", chosen))
        sensor = WrenchSensor(frames, load, chosen["cutoff_hz"], -1.0 if chosen["wrench_by_tool"] else 1.0)
        farthest = 1.05 * (chain.reach() + float(np.linalg.norm(chain.origins[0, :3, 3])))
        return cls(urdf, chain, sensor, farthest)


def limits(chain: Chain, chosen: dict[str, Any]) -> Limits:
    """What the arm may be told, by these parameters."""
    turning = chain.revolute
    return Limits(
        joint_speed=np.where(turning, chosen["joint_speed_rad_s"], chosen["joint_speed_m_s"]),
        joint_acceleration=np.where(turning, chosen["joint_acceleration_rad_s2"], chosen["joint_acceleration_m_s2"]),
        speed=chosen["max_speed_m_s"],
        acceleration=chosen["max_acceleration_m_s2"],
        angular_speed=chosen["max_angular_speed_rad_s"],
        angular_acceleration=chosen["max_angular_acceleration_rad_s2"],
        force=chosen["max_force_n"],
        moment=chosen["max_moment_nm"],
        displacement=chosen["max_displacement_m"],
        rotation=chosen["max_rotation_rad"],
        timeout=chosen["timeout_s"],
        period=1.0 / chosen["rate_hz"],
        gain=chosen["min_gain"],
    )


def task(chosen: dict[str, Any]) -> ImpedanceTask:
    """The task that parameters ask for. Raises ModcalError for values that make no sense together."""
    if chosen["mode"] not in ("expected", "admittance"):
        raise BadTable(f"mode '{chosen['mode']}'", "is neither expected nor admittance", "set one of them")
    if chosen["wrench"] not in ("sensor", "efforts"):
        raise BadTable(f"wrench '{chosen['wrench']}'", "is neither sensor nor efforts", "set one of them")
    for name, share in (("slowdown_force_n", _SLOWS), ("stop_force_n", _STANDS)):  # as asked, or shares of the most
        chosen = {**chosen, name: chosen[name] or share * chosen["max_force_n"]}
    for what in ("force_n", "moment_nm"):
        names = [f"{name}_{what}" for name in ("slowdown", "stop", "max")]
        slow, stop, most = (chosen[name] for name in names)
        if not slow < stop <= most:
            raise BadTable(
                ", ".join(f"{name} {chosen[name]:g}" for name in names),
                "must rise from the first to the last",
                "change them",
            )
    goal = chosen["goal"]
    out = ImpedanceTask(
        direction=_numbers("direction", chosen),
        goal_rad=goal or chosen["goal_rad"],
        goal_m=goal or chosen["goal_m"],
        mode=chosen["mode"],
        exploration_speed=chosen["exploration_speed_m_s"],
        speed=chosen["speed_m_s"],
        max_exploration=chosen["max_exploration_m"],
        mass=_three("mass", chosen),
        damping=_three("damping", chosen),
        stiffness=_three("stiffness", chosen),
        stack=(float(_numbers("stack_stiffness", chosen, 2)[0]), float(_numbers("stack_stiffness", chosen, 2)[1])),
        blend=chosen["blend_s"],
        tare_s=chosen["tare_s"],
        servo_lag=chosen["servo_lag_s"],
        gravity=_numbers("gravity", chosen),
        governor=GovernorSettings(
            slowdown=(chosen["slowdown_force_n"], chosen["slowdown_moment_nm"]),
            stop=(chosen["stop_force_n"], chosen["stop_moment_nm"]),
            max_force=chosen["max_force_n"],
            contact_stiffness=chosen["contact_stiffness_n_m"],
            max_lead=max(_LEAD, _LEAD_SHARE * chosen["max_force_n"] / _three("stiffness", chosen)[0]),
        ),
        input_timeout_s=chosen["patience_s"],
        arm_stiffness=chosen["arm_stiffness_n_m"],
        wrench=chosen["wrench"],
    )
    out.gains(out.direction)  # refuses what is no gain, and no direction
    if out.mode == "admittance":
        _require_damping(out)
    return out


def _require_damping(asked: ImpedanceTask) -> None:
    """Raises BadTable for a damping with which contact would swing: below the servo's stiffness times its lag."""
    along, across, turning = asked.damping
    for what, value, stiff in (
        ("damping along the pull", along, asked.stack[0]),
        ("damping across the pull", across, asked.stack[0]),
        ("damping of turning", turning, asked.stack[1]),
    ):
        if value < (least := stiff * asked.servo_lag):
            said = f"is below {least:g}, stack_stiffness times servo_lag_s, so that contact would oscillate"
            raise BadTable(f"{what} {value:g}", said, "raise damping, or correct the other two")


def _fixed(urdf: str, chain: Chain, frame: str) -> Array:
    """T_tip_frame (4, 4) of a link that moves with the tip."""
    other = read_chain(urdf, chain.base, frame)
    if other.names != chain.names:
        said = f"does not move with {chain.tip}: joints lie between them"
        raise BadTable(f"wrench_frame '{frame}'", said, "name a link that is fixed to the tool")
    q = np.zeros(chain.n)
    return se3.inverse(chain_forward(chain, q)) @ chain_forward(other, q)


def _numbers(name: str, chosen: dict[str, Any], count: int = 3) -> Array:
    out = np.array(chosen[name], dtype=float)
    if out.shape != (count,) or not np.isfinite(out).all():
        raise BadTable(f"{name} {list(chosen[name])}", f"is not {count} finite numbers", "give that many")
    return out


def _three(name: str, chosen: dict[str, Any]) -> tuple[float, float, float]:
    a, b, c = _numbers(name, chosen).tolist()
    return a, b, c


@dataclass(frozen=True)
class JointEfforts:
    """arm: what is known, None where that is not enough. unknown: why not, as text."""

    arm: ArmEfforts | None
    unknown: str = ""

    @classmethod
    def of(cls, urdf: str, chain: Chain) -> JointEfforts:
        """For the masses and efforts that a URDF states."""
        try:
            bodies, full = read_inertias(urdf, chain), read_drives(urdf, chain).torque
        except BadRobot as error:  # what is nonsense can be pulled with, as what is not there
            return cls(None, f"the robot description cannot be used ({error})")
        if not bodies.mass.any():
            return cls(None, "the robot description states no masses")
        if not np.isfinite(full).all():
            return cls(None, "the robot description does not state the effort of every joint")
        return cls(ArmEfforts(chain, bodies, full))

    def said(self, operation: Operation | None) -> str:
        """The force [N] that they show at least in a pull, or why they show none; empty before it moves."""
        if operation is None or operation.phase == "tare":
            return ""
        check = operation.tool_force.efforts
        return (self.unknown or check.unusable) or f"{check.force:.1f}"


_FEW = 3  # joints of one effort are made alike; all of more than that, from shoulder to wrist, are a placeholder


@dataclass(frozen=True)
class JointSoftness:
    """least (n,): stiffness that each joint's servo has at least [N m/rad], NaN where nothing tells. unknown: why not,
    for a person; empty where the leads of joints are judged.
    """

    least: Array
    unknown: str = ""

    @classmethod
    def of(cls, urdf: str, chain: Chain, max_lead: float, held: str = "") -> JointSoftness:
        """For servos that lead by so much [rad] at most under the effort of a URDF.

        held: why it is not joints that are held, as text, where that is known.
        """
        unknown = np.full(chain.n, np.nan)
        if held or not max_lead > 0.0:
            return cls(unknown, held or "max_joint_lead_rad is 0")
        try:
            torque = read_drives(urdf, chain).torque
        except BadRobot as error:  # whose efforts are nonsense can be pulled with, as one that states none
            return cls(unknown, f"the efforts of the robot description cannot be used ({error})")
        stated = torque[chain.revolute & np.isfinite(torque)]
        if not len(stated):
            return cls(unknown, "the robot description states no effort of a joint")
        if len(stated) > _FEW and np.ptp(stated) == 0.0:
            return cls(unknown, f"the robot description states {stated[0]:g} N m for every joint, a placeholder")
        return cls(np.where(chain.revolute, torque / max_lead, np.nan))

    @property
    def said(self) -> str:
        """Which signals limit a force that the sensor hides, as text."""
        if self.unknown:
            return f"the lead of the tool alone ({self.unknown})"
        least, most = np.nanmin(self.least), np.nanmax(self.least)
        return f"the leads of tool and joints (servos of {least:.0f} to {most:.0f} N m/rad at least)"


class ArmInputs:
    """The newest of everything about one arm. motion: what was seen of it while nothing was pulled."""

    def __init__(self, urdf: str, chosen: dict[str, Any]) -> None:
        """chosen: the node's parameters, as they are at any time. Raises BadRobot."""
        self._chosen = chosen
        self.arm = SensedArm.of(urdf, chosen)
        self.chain, self.sensor = self.arm.chain, self.arm.sensor
        self._joints = JointInput(self.chain.names, self.chain.lower, self.chain.upper, self.chain.follows)
        self._tool: tuple[float, Array] | None = None
        self.motion = FreeMotion()

    def take_joints(self, message: JointState, now: float, pulls: bool) -> None:
        """pulls: whether something is being pulled. Raises BadCommand for joint states that cannot be used."""
        self._joints.receive(message, now, self._chosen["timeout_s"])
        if not pulls and self._joints.complete:
            self.motion.take(self.positions(float(self._joints.stamps.min())))

    def take_wrench(self, message: WrenchStamped, now: float, pulls: bool) -> None:
        """pulls: whether something is being pulled. Raises BadCommand for a wrench that cannot be used."""
        timeout = self._chosen["timeout_s"]
        if self.sensor.stamp > now + timeout:  # the clock was set back
            self.sensor.reset()
        stamp = seconds(message.header.stamp) or now
        self.sensor.receive(message.header.frame_id, wrench_numbers(message), stamp, now, timeout)
        if not pulls and self._joints.complete:
            T = pose_and_jacobian(self.chain, self._joints.position)[0]
            self.motion.sensor.take(self.sensor.raw, self.sensor.rotation(T))

    def take_tool(self, message: PoseWithCovarianceStamped) -> None:
        """Raises BadCommand for a pose in another frame, or farther off than the tool can be."""
        if message.header.frame_id not in ("", self.chain.base):
            said = f"is in frame '{message.header.frame_id}', not '{self.chain.base}'"
            raise BadCommand("tool_pose", said, "remap it from the corrector's ~/pose")
        self._tool = seconds(message.header.stamp), desired_pose(message.pose, self.arm.farthest)

    def measured(self, now: float) -> tuple[float, Array]:
        """When [s] and where (4, 4) the tool was measured: by the corrector, if the arm is calibrated, else by its
        joints. Raises BadCommand where the corrector has been silent.
        """
        stamp = float(self._joints.stamps.min())
        if not self._chosen["calibrated"]:
            return stamp, pose_and_jacobian(self.chain, self._joints.position)[0]
        if self._tool is None or not abs(now - self._tool[0]) <= self._chosen["timeout_s"]:
            raise BadCommand(
                "tool_pose", "no message was received recently", "start the corrector, or set calibrated: false"
            )
        return min(stamp, self._tool[0]), self._tool[1]

    def positions(self, stamp: float) -> JointPositions:
        """The joints' positions, and the efforts that they report, as of this stamp [s]."""
        effort = self._joints.effort
        return JointPositions(self._joints.position.copy(), stamp, effort.copy() if np.isfinite(effort).all() else None)

    def require_fresh(self, now: float) -> None:
        """Raises BadCommand unless everything that a pull needs was received recently."""
        timeout = self._chosen["timeout_s"]
        self._joints.require_fresh(now, timeout)
        if self._chosen["wrench"] == "sensor" and not abs(now - self.sensor.stamp) <= timeout:
            remedy = "check that its publisher is alive, or set wrench: efforts"
            raise BadCommand("wrench", "no message was received recently", remedy)
        self.measured(now)


_AT_CONFIGURE = (
    "base", "tip", "calibrated", "tool_mass", "tool_centre", "wrench", "wrench_frame", "wrench_by_tool", "cutoff_hz",
    "timeout_s", "rate_hz",
)  # fmt: skip
WHILE_PULLING = {
    "speed_m_s", "exploration_speed_m_s", "slowdown_force_n", "slowdown_moment_nm", "stop_force_n", "stop_moment_nm",
    "max_force_n", "max_moment_nm", "max_speed_m_s", "max_acceleration_m_s2", "max_angular_speed_rad_s",
    "max_angular_acceleration_rad_s2", "max_displacement_m", "max_rotation_rad", "joint_speed_rad_s", "joint_speed_m_s",
    "joint_acceleration_rad_s2", "joint_acceleration_m_s2", "min_gain", "contact_stiffness_n_m",
    "arm_stiffness_n_m",
}  # fmt: skip


def require_changeable(new: Mapping[str, Any], now: Mapping[str, Any], configured: bool, pulls: bool) -> None:
    """Raises BadCommand for a parameter among the new ones that would have no effect if it changed now.

    now: the present ones. configured, pulls: the state of the node.
    """
    changed = [name for name, value in new.items() if value != now[name]]
    fixed = [name for name in changed if name not in WHILE_PULLING]
    if fixed and pulls:
        raise BadCommand(f"parameter {fixed[0]}", "cannot change while it pulls", "call ~/stop first")
    for name in changed:
        if name in _AT_CONFIGURE and configured:
            raise BadCommand(f"parameter {name}", "is read when the node is configured", "clean it up first")


class SetpointPublishers:
    """One setpoint in the forms that controllers take: pose, wrench and stiffness, or joint references."""

    def __init__(self, node: Node) -> None:
        self._pose = node.create_publisher(PoseStamped, "~/target_pose", 1)
        self._wrench = node.create_publisher(WrenchStamped, "~/target_wrench", 1)
        self._stiffness = node.create_publisher(WrenchStamped, "~/target_stiffness", 1)
        self._references = node.create_publisher(JointTrajectoryPoint, "~/joint_references", 1)
        self._trajectory = node.create_publisher(JointTrajectory, "~/joint_trajectory", 1)

    @property
    def stiffness_taken(self) -> bool:
        """Whether somebody listens to the stiffness that is asked for, as a stack that holds the tool's axes does."""
        return bool(self._stiffness.get_subscription_count())

    def send(self, setpoint: ArmSetpoint, tip: str, now: float, period: float, horizon: float) -> None:
        """Publish a setpoint of the frame tip at this time [s]. period: until the next [s]. horizon: of a trajectory's
        point [s].
        """
        stamp = round(1e9 * now)
        self._references.publish(fill_point(JointTrajectoryPoint(), setpoint, period))
        # a stack listens to one or two of these; a message that nobody hears costs as much as one that is heard
        if self._trajectory.get_subscription_count():
            trajectory = JointTrajectory(joint_names=list(setpoint.names))
            set_seconds(trajectory.header.stamp, now)
            trajectory.points = [fill_point(JointTrajectoryPoint(), setpoint, horizon, with_speed=False)]
            self._trajectory.publish(trajectory)
        if self._pose.get_subscription_count():
            self._pose.publish(fill_posed(PoseStamped(), setpoint.frame, stamp, setpoint.pose))
        if self._wrench.get_subscription_count():
            self._wrench.publish(fill_wrench(WrenchStamped(), tip, stamp, setpoint.wrench))
        if self._stiffness.get_subscription_count():
            self._stiffness.publish(fill_wrench(WrenchStamped(), tip, stamp, setpoint.stiffness))

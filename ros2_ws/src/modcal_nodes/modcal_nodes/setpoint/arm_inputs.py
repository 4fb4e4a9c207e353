"""What ``impedance_setpoint`` hears of one arm (joints, wrench, tool) and the topics on which it says what to do."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from modcal_core.errors import BadCommand
from modcal_core.geometry import Array
from modcal_core.impedance import ArmSetpoint, FreeMotion, JointPositions
from modcal_core.robots import pose_and_jacobian
from modcal_msgs_py import (
    JointInput,
    desired_pose,
    fill_point,
    fill_target,
    fill_wrench,
    seconds,
    set_seconds,
    wrench_numbers,
)
from modcal_nodes.setpoint.arm import SensedArm


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
        self._references.publish(fill_point(JointTrajectoryPoint(), setpoint, period))
        # a stack listens to one or two of these; a message that nobody hears costs as much as one that is heard
        if self._trajectory.get_subscription_count():
            trajectory = JointTrajectory(joint_names=list(setpoint.names))
            set_seconds(trajectory.header.stamp, now)
            trajectory.points = [fill_point(JointTrajectoryPoint(), setpoint, horizon, with_speed=False)]
            self._trajectory.publish(trajectory)
        if self._pose.get_subscription_count():
            self._pose.publish(fill_target(PoseStamped(), setpoint, now))
        if self._wrench.get_subscription_count():
            self._wrench.publish(fill_wrench(WrenchStamped(), tip, now, setpoint.wrench))
        if self._stiffness.get_subscription_count():
            self._stiffness.publish(fill_wrench(WrenchStamped(), tip, now, setpoint.stiffness))

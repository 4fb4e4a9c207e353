"""The topics on which ``impedance_setpoint`` says what an arm is to do."""

from __future__ import annotations

from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.lifecycle import LifecycleNode
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from modcal_core.impedance import ArmSetpoint
from modcal_msgs_py import fill_point, fill_target, fill_wrench, set_seconds


class SetpointPublishers:
    """One setpoint in the forms that controllers take: pose, wrench and stiffness, or joint references."""

    def __init__(self, node: LifecycleNode) -> None:
        self._node = node
        self._pose = node.create_lifecycle_publisher(PoseStamped, "~/target_pose", 1)
        self._wrench = node.create_lifecycle_publisher(WrenchStamped, "~/target_wrench", 1)
        self._stiffness = node.create_lifecycle_publisher(WrenchStamped, "~/target_stiffness", 1)
        self._references = node.create_lifecycle_publisher(JointTrajectoryPoint, "~/joint_references", 1)
        self._trajectory = node.create_lifecycle_publisher(JointTrajectory, "~/joint_trajectory", 1)

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

    def close(self) -> None:
        """Take the topics away."""
        for publisher in (self._pose, self._wrench, self._stiffness, self._references, self._trajectory):
            self._node.destroy_lifecycle_publisher(publisher)

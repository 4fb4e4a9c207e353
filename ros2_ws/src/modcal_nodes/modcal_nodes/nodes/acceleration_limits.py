"""``acceleration_limits``: how hard each joint may be accelerated, here and now, with what the arm carries."""

from __future__ import annotations

from typing import Any

from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from modcal_core.errors import ModcalError
from modcal_core.robots import LoadedArm, Payload, require_method
from modcal_msgs_py import JointInput, fill_accelerations
from modcal_nodes import ros
from modcal_nodes.cli import numbers_by_joint

_DRIVES = {"torque": "torque", "friction": "coulomb", "damping": "viscous", "rotor": "rotor"}


class AccelerationLimits(ros.ManagedNode):
    """Publishes upper and lower bounds of every joint's acceleration from joint states and a payload."""

    executable = "acceleration_limits"
    rest = 0.004  # s

    _described: LoadedArm | None = None

    def _configure(self) -> None:
        self._described = None
        self._arm: LoadedArm | None = None
        self._joints: JointInput | None = None
        self._names: frozenset[str] = frozenset()
        self._urdf, self._refusal = self._chosen["robot_description"], ros.NO_DESCRIPTION
        self._last, self._count = 0, 0  # stamp [ns] of the last bounds, and how many there were

        self._upper = self.create_publisher(JointTrajectory, "~/upper", 10)
        self._lower = self.create_publisher(JointTrajectory, "~/lower", 10)
        always = {"needed": True, "single": True, "replaced": ros.always}
        self._inputs = [
            self.hear(JointState, "joint_states", self._take_joints, ros.FRESH, **always),
            self.hear(String, "robot_description", self._take_description, ros.LATCHED, needed=not self._urdf),
        ]
        if self._urdf and self._chosen["tip"]:
            self._recognise()

    def _activate(self) -> None:
        # apart from the subscriptions: a machine that is too busy for this rate must not work through old ticks
        tick = self._refusals.guarded("limits", self._tick)
        self.every(1.0 / self._chosen["rate_hz"], lambda: tick(None))

    def _take_description(self, message: String) -> None:
        if not self._chosen["robot_description"] and message.data != self._urdf:
            self._urdf, self._described, self._arm = message.data, None, None
            self._refusal = "joint_states: not received yet"
            if self._chosen["tip"] or self._names:
                self._recognise()

    def _recognise(self) -> None:
        chosen = self._chosen
        self._described = self._arm = None
        try:
            arm = LoadedArm.read(self._urdf, chosen["base"] or None, chosen["tip"] or None, self._names or None)
            if self._joints is None or self._joints.names != arm.chain.names:
                self._joints = JointInput(arm.chain.names, arm.chain.lower, arm.chain.upper, arm.chain.follows)
            self._described = arm
            self._arm, self._refusal = _with(arm, chosen), ""
        except ModcalError as error:
            self._refusal = str(error)
            self.get_logger().error(f"refused: {error}")
        self._health.publish_if_changed()

    def _check(self, new: dict[str, Any]) -> None:
        require_method(new["method"])
        _payload(new)
        if self._described is not None:
            _with(self._described, new)

    def _take_parameters(self) -> None:
        if self._described is not None:
            self._arm, self._refusal = _with(self._described, self._chosen), ""

    def _take_joints(self, message: JointState) -> None:
        new = frozenset(message.name)
        if self._described is None and self._urdf and not new <= self._names:
            self._names |= new
            self._recognise()
        if self._joints is not None:
            self._joints.receive(message, self._now(), self._chosen["timeout_s"])

    def _tick(self, _: object = None) -> None:
        arm, joints = self._arm, self._joints
        if arm is None or joints is None or not joints.complete or (stamp := joints.stamp) == self._last:
            return
        joints.require_fresh(self._now(), self._chosen["timeout_s"])
        lower, upper = arm.bounds(joints.position, joints.velocity, self._chosen["method"])
        for publisher, bound in ((self._lower, lower[0]), (self._upper, upper[0])):
            message = JointTrajectory(points=[JointTrajectoryPoint()])
            fill_accelerations(message, joints.names, bound, stamp)
            publisher.publish(message)
        self._last = stamp
        self._count += 1

    def _report(self) -> list[ros.Status]:
        return [ros.subscription_status(self._inputs, self._refusals), self._limits_status()]

    def _limits_status(self) -> ros.Status:
        arm, joints = self._arm, self._joints
        facts: dict[str, object] = {"published": self._count, "refused": self._refusals.counts.total()}
        if arm is None or joints is None:
            return ros.Status("limits", ros.ERROR, self._refusal, facts)
        facts |= {"payload": f"{arm.payload.mass:g} kg", "method": self._chosen["method"]}
        try:
            joints.require_fresh(self._now(), self._chosen["timeout_s"])
            left = arm.window(joints.position, joints.velocity)
            left.require_held()
        except ModcalError as error:
            return ros.Status("limits", ros.ERROR, str(error), facts)
        said = self._refusals.recent()
        return ros.Status("limits", ros.WARN if said else ros.OK, said or "limits are published", facts)


def _payload(chosen: dict[str, Any]) -> Payload:
    return Payload.checked(chosen["payload_kg"], chosen["payload_centre_m"], chosen["payload_inertia"])


def _with(arm: LoadedArm, chosen: dict[str, Any]) -> LoadedArm:
    drives = {core: numbers_by_joint(chosen[name], f"parameter {name}") for name, core in _DRIVES.items()}
    loaded = arm.carrying(_payload(chosen)).using(chosen["torque_share"], chosen["gravity"]).with_drives(**drives)
    loaded.drives.require_torque()
    return loaded

"""``impedance_setpoint``: opens a door or a drawer gently, setpoint by setpoint. A lifecycle node."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, WrenchStamped
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from modcal_core.articulation import frames, read
from modcal_core.errors import BadCommand, ModcalError
from modcal_core.impedance import ArmSetpoint, Operation, Stop, Wait
from modcal_msgs_py import ObjectInput, fill_identity
from modcal_nodes import ros
from modcal_nodes.setpoint import (
    ArmInputs,
    JointEfforts,
    JointSoftness,
    SetpointPublishers,
    limits,
    require_changeable,
    task,
)

_TICKS = 2000  # of which the times are remembered
_LET_GO = 2.0  # s, the longest that letting go takes
_LATE = 1.5  # periods between two ticks
_BEGUN = "weighing the tool, then pulling"


class ImpedanceSetpoint(ros.ManagedNode):
    """Publishes what an arm is to do while it pulls; nothing while it is inactive, and nothing that it should not."""

    executable = "impedance_setpoint"
    rest = 0.004  # s, while nothing is pulled

    _arm: ArmInputs | None = None
    _operation: Operation | None = None

    def _serve(self) -> None:
        self._action = ros.Action(self, "Pull", self._begin_pull, partial(self._let_go, "cancelled"), self._progress)
        self.offer("~/pull", lambda: (not (refusal := self._begin_pull()), refusal or _BEGUN))
        self.offer("~/stop", self._stop)

    @property
    def hurried(self) -> bool:
        """Whether something is being pulled."""
        return self._operation is not None

    def _refused(self, said: str) -> None:
        """What cannot be done from here is answered, and nothing goes on being pulled."""
        self._let_go(said)
        super()._refused(said)

    def _check(self, new: dict[str, Any]) -> None:
        """Raises BadCommand for a change that would have no effect now, BadTable for values that cannot be."""
        require_changeable(new, self._chosen, self.configured, self._operation is not None)
        task(new)

    def _take_parameters(self) -> None:
        """What is being pulled keeps to the limits as they are now."""
        if self._operation is not None and self._arm is not None:
            self._operation.restrict(task(self._chosen), limits(self._arm.chain, self._chosen), self._now())

    def _configure(self) -> None:
        self._arm, self._object = None, ObjectInput(read, frames)
        self._judged_by, self._largest, self._efforts = "", 0.0, JointEfforts(None)
        self._counts = {"setpoints": 0, "late ticks": 0}
        self._took: deque[float] = deque(maxlen=_TICKS)
        self._before = 0.0
        self.said, self.level = "nothing was pulled yet", ros.OK
        self._outputs = SetpointPublishers(self)
        by_sensor, urdf = self._chosen["wrench"] == "sensor", self._chosen["robot_description"]
        heard: list[tuple[type, str, Callable[[Any], None], QoSProfile, bool]] = [
            (JointState, "joint_states", self._take_joints, ros.FRESH, True),
            (WrenchStamped, "wrench", self._take_wrench, ros.FRESH, by_sensor),
            (String, "robot_description", self._take_description, ros.LATCHED, not urdf),
            (String, "object_description", self._object.hear_description, ros.LATCHED, False),
            (ros.interface("ObjectState"), "object_status", self._take_object, ros.FRESH, False),
            (PoseWithCovarianceStamped, "tool_pose", self._take_tool, ros.FRESH, self._chosen["calibrated"]),
        ]
        self._inputs = [self.hear(*of, needed=needed, single=needed, replaced=ros.always) for *of, needed in heard]
        if urdf:
            self._refusals.guarded("robot_description", self._describe)(urdf)

    def _activate(self) -> None:
        self.create_timer(1.0 / self._chosen["rate_hz"], self._tick)
        self._tell(ros.OK, "ready")

    def _deactivate(self) -> None:
        """Stop whatever is going on; nothing is published any more."""
        self._let_go("deactivated")

    def _let_go(self, why: str) -> None:
        """Let go of what is pulled, before anything else is done: a servo would hold on to where it was sent last."""
        operation = self._operation
        if operation is None:
            return
        try:
            ticked = self._now()
            operation.release(why, ticked)
            end = time.monotonic() + _LET_GO
            while self._operation is not None and time.monotonic() < end and self.context.ok():
                time.sleep(1.0 / self._chosen["rate_hz"])
                self._hear_on()
                if (now := self._now()) > ticked:  # a simulated time goes on when the arm does
                    ticked = now
                    self._tick_once()
        except Exception as error:
            self.faults.note("letting go", error)
        if self._operation is not None:
            self._finish(self._operation.stop(why))

    def _hear_on(self) -> None:
        """Take what has arrived while the executor waits for a callback to end, the time included."""
        self.take_time()
        for subscription in self._inputs:
            subscription.poll()

    def _begin_pull(self) -> str:
        """Begin to pull; returns why not, or nothing."""
        refusal = ""
        try:
            self._begin()
        except ModcalError as error:
            # what is refused message by message counts as silence; the refusal says why
            refusal = self._refusals.standing(error.offender) or str(error)
        self._health.publish()
        return refusal

    def _progress(self, feedback: Any) -> None:
        if self._operation is not None:
            bound = self._operation.tool_force.bound
            said = f"at most {bound:.0f} N when {self._operation.limits.force:g} N are felt" if bound == bound else ""
            feedback.phase, feedback.message = self._operation.phase, "; ".join(filter(None, (self.said, said)))
            feedback.force_n = float(np.linalg.norm(self._operation.force[:3]))
            feedback.trusted = self._object.at(self._now()).trusted

    def _stop(self) -> tuple[bool, str]:
        """Let go of what is pulled, and pull no more; answered when that is done."""
        if self._operation is None:
            return True, "nothing was pulled"
        self._let_go("stopped as asked")
        return True, self.said

    def _begin(self) -> None:
        if self._object.elsewhere:
            raise BadCommand("object_description", self._object.elsewhere, "track the handle in the arm's base link")
        if self._operation is not None:
            raise BadCommand("pull", f"it is pulling already ({self._operation.phase})", "call ~/stop first")
        if self._arm is None:
            raise BadCommand("robot_description", "not received yet", "publish it (latched), or set the parameter")
        self._arm.require_fresh(self._now())
        arm, softness = self._arm, self._softness(self._arm)
        self._efforts = JointEfforts.of(arm.arm.urdf, arm.chain)
        known = limits(arm.chain, self._chosen), softness.least, self._efforts.arm, arm.motion
        self._operation = Operation(arm.chain, task(self._chosen), *known)
        self._judged_by, self._largest = softness.said, 0.0
        if softness.unknown:
            self.get_logger().warning(f"a force that the sensor does not tell is judged by {softness.said}")
        self._tell(ros.OK, "tare")

    def _softness(self, arm: ArmInputs) -> JointSoftness:
        held = ""
        if self._chosen["mode"] != "admittance":
            held = f"mode is {self._chosen['mode']}: the stack is compliant itself"
        elif self._outputs.stiffness_taken:
            held = "a controller listens to ~/target_stiffness: it holds the tool's axes"
        return JointSoftness.of(arm.arm.urdf, arm.chain, self._chosen["max_joint_lead_rad"], held)

    def _take_description(self, message: String) -> None:
        known = self._chosen["robot_description"] or (self._arm is not None and message.data == self._arm.arm.urdf)
        if not known:
            self._describe(message.data)

    def _describe(self, urdf: str) -> None:
        """Know the arm; one that is pulling stays as it is."""
        if self._operation is not None:
            raise BadCommand("robot_description", "changes while it pulls", "it is applied when the pull is over")
        self._arm = None
        self._arm = ArmInputs(urdf, self._chosen)
        self._object.in_base(self._arm.chain.base)

    def _take_joints(self, message: JointState) -> None:
        if self._arm is not None:
            self._arm.take_joints(message, self._now(), self._operation is not None)

    def _take_wrench(self, message: WrenchStamped) -> None:
        if self._arm is not None:
            self._arm.take_wrench(message, self._now(), self._operation is not None)

    def _take_object(self, message: Any) -> None:
        self._object.hear_status(message, self._now())

    def _take_tool(self, message: PoseWithCovarianceStamped) -> None:
        if self._arm is not None:
            self._arm.take_tool(message)

    def _tick(self) -> None:
        """One setpoint; a fault in the middle of a pull ends it."""
        try:
            self._tick_once()
        except Exception as error:
            if not self.context.ok():
                raise
            self._let_go(f"the pull was aborted: {self.faults.note('tick', error)}")

    def _tick_once(self) -> None:
        operation, arm = self._operation, self._arm
        if operation is None or arm is None:
            return
        begun, now = time.perf_counter(), self._now()
        self._counts["late ticks"] += begun - self._before > _LATE / self._chosen["rate_hz"]
        self._before = begun
        try:
            stamp, T = arm.measured(now)
        except ModcalError as error:
            stamp, T = -np.inf, np.eye(4)  # too old for anything, which the operation waits for
            self._refusals.refuse("tool_pose", str(error))
        self._largest = max(self._largest, float(np.linalg.norm(operation.force[:3])))
        answer = operation.tick(now, T, arm.sensor, arm.positions(stamp), self._object.at(now))
        if isinstance(answer, ArmSetpoint):
            self._send(answer, arm.chain.tip, now)
            self._tell(ros.OK, operation.phase)
        elif isinstance(answer, Wait):
            self._tell(ros.OK if operation.phase == "tare" else ros.WARN, answer.why)
        else:
            self._finish(answer)
        self._took.append(time.perf_counter() - begun)

    def _send(self, setpoint: ArmSetpoint, tip: str, now: float) -> None:
        self._outputs.send(setpoint, tip, now, 1.0 / self._chosen["rate_hz"], self._chosen["horizon_s"])
        self._counts["setpoints"] += 1

    def _finish(self, stop: Stop) -> None:
        self._operation = None
        self._tell(ros.OK if stop.done else ros.ERROR, stop.why)
        ended = ros.DONE if stop.done else ros.FAILED
        chain = None if self._arm is None else self._arm.chain
        about = fill_identity(ros.interface("Identity")(), chain, ["object_status"])
        self._action.end(ended, stop.why, opened=float(stop.opened), largest_force_n=self._largest, about=about)
        self._health.publish()

    def _report(self) -> list[ros.Status]:
        refused = self._refusals.recent()
        took = np.percentile(self._took, [50.0, 99.0]) * 1e3 if self._took else (0.0, 0.0)
        facts = {
            **self._counts,
            "refused": self._refusals.counts.total(),
            "phase": self._operation.phase if self._operation else "",
            "force N": f"{float(np.linalg.norm(self._operation.force[:3])):.1f}" if self._operation else "",
            "unfelt force judged by": self._judged_by,
            "joints yield to what is felt": self._operation.tool_force.servos if self._operation else "",
            "force by joint efforts N": self._efforts.said(self._operation),
            "tick ms, median": f"{took[0]:.2f}",
            "tick ms, 99 %": f"{took[1]:.2f}",
        }
        model = self._object.kind if self._object.model is not None else "none"
        trusted = {"model": model, "trusted": self._object.at(self._now()).trusted}
        hearing = ros.subscription_status(self._inputs, self._refusals)
        deaf = self.said == "ready" and hearing.level != ros.OK
        said = f"not ready: {hearing.message}" if deaf else self.said
        return [
            hearing,
            ros.Status("inputs", ros.WARN if refused else ros.OK, refused or "no recent refusal", trusted),
            ros.Status("pull", hearing.level if deaf else self.level, said, facts),
        ]

"""``corrector``: where the arm truly is, and what to command so that it truly comes to be where it is wanted."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState, Range, Temperature
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from modcal_core import correction  # what measures boxes computes, and is loaded when it is asked
from modcal_core.calibration import Calibration
from modcal_core.correction import (
    ArmState,
    CalibratedRobot,
    Commander,
    CommanderSettings,
    JointSetpoint,
    corrected_urdf,
    finite,
)
from modcal_core.errors import BadCommand, BadTable, ModcalError
from modcal_core.measurements import RAY, Approach, ReadingTrack
from modcal_msgs_py import (
    JointInput,
    SignalsHeard,
    asked_of_box,
    desired_pose,
    fill_held_box,
    fill_joints,
    fill_pose,
    require_new,
    seconds,
    set_nanoseconds,
    set_seconds,
)
from modcal_nodes import ros
from modcal_nodes.io import calibration_of, read_delta

# The newest is all that counts: a queue would only make it old.
_NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE)
_MOST_RANGES = 20_000  # readings of range sensors that are kept
_SECONDS = 1.0  # of them that count for a box, where a request does not say
_NOTHING_YET = "no calibration yet: set the parameter calibration, or publish the topic calibration"


class Corrector(ros.ManagedNode):
    """Publishes true poses, effective joint states, the corrected URDF, and commands for desired true poses."""

    executable = "corrector"
    rest = 0.004  # s, little beside the tenth of a second that a setpoint looks ahead

    def _serve(self) -> None:
        self.offer("~/reset", self._reset)
        self.create_service(ros.interface("MeasureObject"), "~/measure_object", self._measure_object)

    def _configure(self) -> None:
        self._commander = Commander(_settings(self._chosen))
        self._calibration: Calibration | None = None
        self._heard: Any = None  # the last message of a calibration
        self._refusal = _NOTHING_YET
        self._urdf = self._chosen["robot_description"]
        self._delta = read_delta(Path(self._chosen["delta"])) if self._chosen["delta"] else None
        self._joints: JointInput | None = None
        self._approach, self._signals = Approach(), SignalsHeard()
        self._ranges: deque[tuple[str, float, float]] = deque(maxlen=_MOST_RANGES)
        self._announced: CalibratedRobot | None = None
        self._last = -np.inf
        self._counts = {"poses": 0, "commands": 0}

        self._pose = self.create_publisher(PoseWithCovarianceStamped, "~/pose", 10)
        self._states = self.create_publisher(JointState, "~/joint_states", 10)
        self._trajectory = self.create_publisher(JointTrajectory, "~/joint_trajectory", 10)
        self._corrected = self.create_publisher(String, "~/robot_description", ros.LATCHED)
        self._tf = ros.Broadcaster(self, static=False) if self._chosen["publish_tf"] else None
        self._inputs = [
            self.hear(JointState, "joint_states", self._take_joints, ros.FRESH, needed=True, replaced=ros.always),
            self.hear(Temperature, "temperature", self._take_temperature, ros.FRESH),
            self.hear(PoseStamped, "desired_pose", self._take_desired, _NEWEST, single=True),
            self.hear(Range, "gripper/range", self._take_range, ros.SENSOR),
            self.hear(String, "robot_description", self._take_description, ros.LATCHED),
            self.hear(ros.interface("Calibration"), "calibration", self._take_calibration, ros.LATCHED),
        ]
        if self._chosen["calibration"]:
            self._calibration = Calibration.load(Path(self._chosen["calibration"]))
        self._meet()

    def _activate(self) -> None:
        self._approach, self._announced = Approach(), None
        self._announce()

    def _deactivate(self) -> None:
        self._withdraw()

    def _check(self, new: dict[str, Any]) -> None:
        _settings(new)

    def _take_parameters(self) -> None:
        self._commander.settings = _settings(self._chosen)

    def _take_description(self, message: String) -> None:
        if not self._chosen["robot_description"] and message.data != self._urdf:
            self._urdf = message.data
            self._meet()

    def _take_calibration(self, message: Any) -> None:
        if self._chosen["calibration"] or message == self._heard:
            return
        self._heard = message
        try:
            self._calibration = calibration_of(message, "topic calibration")
        except ModcalError as error:
            # the one in use was made for this robot, and stays
            self._refusals.refuse("calibration", str(error))
            self._refusal = self._refusal if self._commander.robot else str(error)
            return
        self._meet()

    def _reset(self) -> tuple[bool, str]:
        """Forget the calibration and the stream; read the file again, if one was named."""
        self._calibration, self._heard = None, None
        self._drop("reset, and no calibration since")
        try:
            if self._chosen["calibration"]:
                self._calibration = Calibration.load(Path(self._chosen["calibration"]))
                self._meet()
            done, said = True, self._refusal or "read again"
        except ModcalError as error:
            done = False
            said = self._refusal = str(error)
        self._health.publish()
        return done, said

    def _meet(self) -> None:
        """Put calibration and robot together, if both are there and belong together; else correct nothing."""
        if self._calibration is None:
            return
        if not self._urdf and self._delta is None:
            self._refusal = ros.NO_DESCRIPTION
            return
        try:
            robot = CalibratedRobot.of(self._calibration, self._delta or self._urdf)
            corrected_urdf(robot, self._urdf)
        except ModcalError as error:
            self._drop(str(error))
            self.get_logger().error(f"refused: {error}")
        else:
            bounds = robot.bounds(self._commander.settings)
            if self._joints is None or self._joints.names != bounds.names:
                follows = robot.correction.chain.follows
                self._joints = JointInput(bounds.names, bounds.lower, bounds.upper, follows)
                self._approach = Approach()
            self._refusal = ""
            self._commander.use(robot, self._now())
            self._announce()
        self._health.publish()

    def _announce(self) -> None:
        robot = self._commander.robot
        if self.active and robot is not None and robot is not self._announced:
            self._announced = robot
            if urdf := corrected_urdf(robot, self._urdf):
                self._corrected.publish(String(data=urdf))
            self.get_logger().info(f"corrects robot {robot.correction.calibration.robot}")

    def _drop(self, why: str) -> None:
        self._refusal = why
        self._commander.drop()
        self._announced = None
        self._withdraw()

    def _withdraw(self) -> None:
        # a late listener must not find the URDF of a calibration that is no longer trusted
        self.destroy_publisher(self._corrected)
        self._corrected = self.create_publisher(String, "~/robot_description", ros.LATCHED)

    def _take_temperature(self, message: Temperature) -> None:
        self._signals.hear_temperature(message, self._now())

    def _take_range(self, message: Range) -> None:
        if 0.0 < message.range < np.inf:
            self._ranges.append((message.header.frame_id, seconds(message.header.stamp), message.range))

    def _measure_object(self, request: Any, answer: Any) -> Any:
        """The box that rests in the gripper now."""
        if self.idle:
            answer.message = self.idle
            return answer
        since = self._now() - (request.seconds or _SECONDS)
        heard = [(name, at, length) for name, at, length in self._ranges if at >= since]
        try:
            if self._calibration is None:
                raise BadCommand("measure_object", self._refusal, "provide a valid calibration first")
            size, place = asked_of_box(request)
            rays = correction.GripperRays.of(self._calibration, self._chosen["target"])
            readings = [
                ReadingTrack(RAY, name, t, np.array([d for n, _, d in heard if n == name])[:, None], t)
                for name in sorted({name for name, _, _ in heard})
                for t in [np.array([t for n, t, _ in heard if n == name])]
            ]
            held = correction.held_box(
                rays, readings, correction.rests(rays, readings)[-1], rays.faces(request.faces), size
            )
        except ModcalError as error:
            answer.done, answer.message = False, str(error)
            return answer
        put = None if place is None else correction.placing(held, place)
        return fill_held_box(answer, held, put, self._calibration.calibrated.chain.base)

    def _take_joints(self, message: JointState) -> None:
        if self._joints is None:
            return
        now = self._now()
        self._joints.receive(message, now, self._chosen["timeout_s"])
        if not self._joints.complete:
            return
        self._approach.update(self._joints.position)
        self._commander.paused(now)
        self._announce()
        due = not 0.0 <= now - self._last < 0.999 / self._chosen["rate_hz"]
        if due and self._commander.robot is not None:
            self._joints.require_fresh(now, self._chosen["timeout_s"])
            self._correct(self._commander.robot, self._joints, self._conditions(self._joints, now))
            self._last = now

    def _correct(self, robot: CalibratedRobot, joints: JointInput, at: ArmState) -> None:
        correction, target = robot.correction, self._commander.settings.target
        correction.require(at)
        T, C, q = correction.corrected(at, target)
        finite(T, C, q)
        pose = PoseWithCovarianceStamped()
        pose.header.frame_id = correction.chain.base
        set_nanoseconds(pose.header.stamp, joints.stamp)
        fill_pose(pose.pose, T, C)
        self._pose.publish(pose)
        if self._tf is not None:
            tip = T if target == "tip" else correction.pose(at.q, at, "tip")
            frame = ros.corrected_frame(correction.chain.base, correction.chain.tip, tip)
            self._tf.publish([frame], pose.header.stamp)
        self._states.publish(fill_joints(JointState(), joints.names, joints.stamp, q, at.velocity))
        self._counts["poses"] += 1

    def _take_desired(self, message: PoseStamped) -> None:
        robot, joints, chosen = self._commander.robot, self._joints, self._chosen
        if robot is None or joints is None:
            raise BadCommand(
                "desired_pose", f"no command is corrected ({self._refusal})", "provide a valid calibration first"
            )
        require_new(message, self._now(), chosen["timeout_s" if chosen["stream"] else "goal_timeout_s"])
        pose = desired_pose(message, robot.farthest)
        joints.require_fresh(self._now(), chosen["timeout_s"])
        at = self._conditions(joints, self._now())
        try:
            self._commander.change_over(at, at.stamp)
            self._announce()
        except ModcalError as error:
            self._refusals.refuse("calibration", str(error))
        setpoint = self._commander.setpoint(pose, message.header.frame_id, at, at.stamp)
        now = self._now()
        if chosen["stream"]:
            joints.require_fresh(now, chosen["timeout_s"])  # computing took time too; a goal has all the time it needs
        self._send(joints.names, setpoint, now)
        self._commander.sent(setpoint, now)
        if unseen := setpoint.command.unseen:
            self._refusals.refuse("range", f"{', '.join(unseen)}: commanded outside the range that was calibrated")

    def _send(self, names: tuple[str, ...], setpoint: JointSetpoint, now: float) -> None:
        finite(setpoint.q, np.array(setpoint.seconds))
        message = JointTrajectory(joint_names=list(names))
        set_seconds(message.header.stamp, now)
        point = JointTrajectoryPoint(positions=setpoint.q.tolist())
        set_seconds(point.time_from_start, setpoint.seconds)
        message.points = [point]
        self._trajectory.publish(message)
        self._counts["commands"] += 1

    def _conditions(self, joints: JointInput, now: float) -> ArmState:
        needs = self._commander.robot.correction.needs if self._commander.robot else ()
        came = self._approach.direction if len(self._approach.direction) else np.zeros(len(joints.names))
        at = joints.position.copy(), joints.velocity.copy(), came.copy(), joints.effort.copy()
        return ArmState(now, *at, self._signals.tracks(needs), self._approach.path.copy())

    def _report(self) -> list[ros.Status]:
        robot, counts = self._commander.robot, self._counts
        commands = {"commands": counts["commands"], "refused": self._refusals.counts["desired_pose"]}
        said = self._refusals.recent("desired_pose", "range")
        return [
            ros.subscription_status(self._inputs, self._refusals),
            self._calibration_status(robot) if robot else ros.Status("calibration", ros.ERROR, self._refusal),
            self._correction_status(robot) if robot else ros.Status("correction", ros.ERROR, "no command is corrected"),
            ros.Status("commands", ros.WARN if said else ros.OK, said or "no recent refusal", commands),
        ]

    def _calibration_status(self, robot: CalibratedRobot) -> ros.Status:
        correction = robot.correction
        claim = correction.calibration.claim_mm
        facts = {"robot": correction.calibration.robot, "effects": len(correction.model.effects)}
        facts["claim p95 [mm]"] = "none" if claim is None else f"{claim:.4f}"
        said = self._refusals.recent("calibration")
        if self._commander.waiting is not None:
            said = f"a new one waits for the stream to pause; {said}".rstrip("; ")
        elif not said and correction.calibration.uncertainty is None:
            said = "has no uncertainty, so poses show scatter only: calibrate again"
        elif not said and correction.unwatched(self._now()):
            said = "was recorded at another time: drifts are held as they were: calibrate again"
        return ros.Status("calibration", ros.WARN if said else ros.OK, said or "in use", facts)

    def _correction_status(self, robot: CalibratedRobot) -> ros.Status:
        now, joints, correction = self._now(), self._joints, robot.correction
        facts = {"poses": self._counts["poses"]}
        assert joints is not None
        try:
            joints.require_fresh(now, self._chosen["timeout_s"])
            at = self._conditions(joints, now)
            correction.require(at)
        except ModcalError as error:
            return ros.Status("correction", ros.ERROR, str(error), facts)
        said = self._refusals.recent("joint_states", "temperature")
        if not said and self._tf is not None:
            said = self._tf.trouble
        if silent := self._signals.silent(correction.needs, now):
            said = f"{', '.join(silent)}: silent, the last value is used"
        elif unseen := correction.unseen(at.q):
            said = f"{', '.join(unseen)}: outside the range that was calibrated; learned curves end before"
        return ros.Status("correction", ros.WARN if said else ros.OK, said or "poses are corrected", facts)


def _settings(chosen: dict[str, Any]) -> CommanderSettings:
    if chosen["target"] not in ("tip", "tool"):
        raise BadTable(f"target '{chosen['target']}'", "must be tip or tool", "set one of them")
    return CommanderSettings(
        target=chosen["target"],
        stream=chosen["stream"],
        horizon=chosen["horizon_s"],
        turning=chosen["joint_speed_rad_s"],
        sliding=chosen["joint_speed_m_s"],
        tolerance_m=chosen["tolerance_m"],
        tolerance_rad=chosen["tolerance_rad"],
        switch_step=chosen["switch_step_rad"],
        blend=chosen["blend_s"],
    )

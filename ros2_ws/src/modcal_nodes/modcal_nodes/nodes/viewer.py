"""``viewer``: shows in RViz and Foxglove what a calibration gets wrong, what it moved, and how well it is known."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.clock import Clock, ClockType
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import String
from visualization_msgs.msg import Marker, MarkerArray

from modcal_core.calibration import Calibration
from modcal_core.correction import ArmState, CalibratedRobot, tool_ellipsoid
from modcal_core.errors import BadCommand, ModcalError
from modcal_core.geometry import Array
from modcal_core.measurements import POINT, POSE, Approach
from modcal_msgs_py import JointInput, SignalsHeard, require_version
from modcal_nodes import ros, viewing
from modcal_nodes.calibrating import KnownArm
from modcal_nodes.io import calibration_of
from modcal_nodes.viewing import JudgedStations, Stations

_REST = 0.003  # s
_LIFETIME = 2.0  # s that axes and ellipsoids outlive this node by
_NOTHING_YET = "no calibration yet: run a calibrator beside this node, or remap calibrator/calibration"
_NO_ARM_YET = "publish robot_description (latched) and joint_states"


class Viewer(ros.GuardedNode):
    """Publishes pictures of residuals, stations, joint axes and uncertainty in the arm's base link."""

    def __init__(self) -> None:
        super().__init__("viewer")
        self._chosen = chosen = ros.declare(self, ros.VIEWER)
        self._urdf, self._names = chosen["robot_description"], frozenset[str]()
        self._calibration: Calibration | None = None
        self._heard: Any = None  # the last message of a calibration
        self._change = self._missing = self._unseen = self._frame = ""
        self._refusal = _NOTHING_YET
        self._robot: CalibratedRobot | None = None
        self._signals = SignalsHeard()
        self._stations = Stations(chosen["stations"])
        self._judged: JudgedStations | None = None
        self._shapes: dict[float, tuple[Array, Array]] = {}  # ellipsoids at the last stations, by their stamps
        self._around_stations: list[Marker] = []
        self._look_at(chosen["base"], chosen["tip"])
        ros.follow(self, ros.VIEWER, chosen, take=self._take_parameters)
        self._refusals = ros.Refusals(self, lambda: self._health.publish_if_changed())

        self._residuals = self.create_publisher(MarkerArray, "~/residuals", ros.LATCHED)
        self._dots = self.create_publisher(MarkerArray, "~/stations", ros.LATCHED)
        self._axes = self.create_publisher(MarkerArray, "~/axes", 10)
        self._ellipsoids = self.create_publisher(MarkerArray, "~/uncertainty", 10)
        self._inputs = self._listen()
        self._health = ros.Health(self, self._report)
        self.offer("~/reset", self._reset)
        self.create_timer(1.0 / chosen["rate_hz"], self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _listen(self) -> list[ros.MonitoredSubscription]:
        guarded = self._refusals.guarded
        heard: dict[str, tuple[type, Callable[[Any], None], Any]] = {  # by topic: message, what takes it, its QoS
            "joint_states": (JointState, self._take_joints, ros.SENSOR),
            "tracker/pose": (PoseStamped, guarded("tracker/pose", partial(self._take_reading, POSE)), ros.SENSOR),
            "tracker/point": (PointStamped, guarded("tracker/point", partial(self._take_reading, POINT)), ros.SENSOR),
            "temperature": (Temperature, guarded("temperature", self._take_temperature), ros.SENSOR),
            "calibrator/calibration": (ros.interface("Calibration"), self._take_calibration, ros.LATCHED),
            "calibrator/change": (ros.interface("Change"), guarded("change", self._take_change), ros.LATCHED),
            "robot_description": (String, self._take_description, ros.LATCHED),
        }
        options: dict[str, dict[str, Any]] = {
            "joint_states": {"needed": True, "single": True},
            "calibrator/calibration": {"single": True},
            "robot_description": {"needed": not self._chosen["robot_description"]},
        }
        return [
            ros.MonitoredSubscription(self, message, topic, take, qos, **options.get(topic, {}))
            for topic, (message, take, qos) in heard.items()
        ]

    def _take_temperature(self, message: Temperature) -> None:
        self._signals.hear_temperature(message, self._now())

    def _take_parameters(self) -> None:
        self._dirty = True

    def _look_at(self, base: str, tip: str) -> None:
        """Start over with the arm between these links; what was seen of another one is forgotten."""
        self._arm = KnownArm(self._urdf, base, tip)
        self._joints: JointInput | None = None
        self._approach = Approach()
        self._stations.clear()
        self._judged = None
        self._shapes.clear()
        self._asked, self._dirty = (base, tip), True
        self._recognise()

    def _recognise(self) -> None:
        if self._arm.recognise(self._names) and self._arm.chain is not None:
            chain = self._arm.chain
            self._joints = JointInput(chain.names, chain.lower, chain.upper, chain.follows)
            self._dirty = True

    def _take_description(self, message: String) -> None:
        if not self._chosen["robot_description"] and message.data != self._urdf:
            self._urdf = message.data
            self._meet()

    def _take_calibration(self, message: Any) -> None:
        if message == self._heard:
            return
        self._heard = message
        try:
            self._calibration = calibration_of(message, "topic calibrator/calibration")
        except ModcalError as error:
            self._refusals.refuse("calibration", str(error))  # the one in use was made for this robot, and stays
            return
        self._meet()

    def _meet(self) -> None:
        """Put calibration and robot together, if both are there and belong together; else show the nominal arm only."""
        self._robot, self._dirty = None, True
        self._shapes.clear()
        base, tip = self._chosen["base"], self._chosen["tip"]
        if self._calibration is not None and self._urdf:
            try:
                self._robot = CalibratedRobot.of(self._calibration, self._urdf)
                self._refusal, base, tip = "", self._robot.described.base, self._robot.described.tip
            except ModcalError as error:
                self._refusal = str(error)
                self.get_logger().error(f"refused: {error}")
        chain = self._arm.chain
        ends = (base, tip) if chain is None else (chain.base, chain.tip)
        if self._arm.description != self._urdf or (base, tip) not in (self._asked, ends):
            self._look_at(base, tip)
        self._health.publish()

    def _take_change(self, message: Any) -> None:
        """Remember the sentence that says what has changed since the calibration."""
        require_version(message, "change")
        self._change, self._dirty = message.sentence, True

    def _reset(self) -> tuple[bool, str]:
        self._stations.clear()
        self._dirty = True
        return True, "stations forgotten"

    def _take_joints(self, message: JointState) -> None:
        if not self._names.issuperset(message.name):
            self._names = self._names.union(message.name)
            self._recognise()
        if self._joints is None:
            return
        if len(message.position) != len(message.name):
            count = f"{len(message.position)} positions for {len(message.name)} names"
            self._refusals.refuse("joint_states", f"joint_states: {count}: send one for every name")
            return
        try:
            self._arm.joint_state(message)
            self._joints.receive(message, self._now(), self._chosen["timeout_s"])
            if not self._joints.missing():
                self._approach.update(self._joints.position)
        except ModcalError as error:
            self._refusals.refuse("joint_states", str(error))
        self._collect()

    def _take_reading(self, kind: str, message: Any) -> None:
        self._arm.reading(kind, message)
        self._collect()

    def _collect(self) -> None:
        for sample in self._arm.stream.take() if self._arm.stream else ():
            self._dirty = self._stations.add(sample) or self._dirty

    def _tick(self) -> None:
        if self._dirty:
            self._dirty = False
            self._draw_stations()
        self._draw_posture()

    def _draw_stations(self) -> None:
        chain, robot, chosen = self._arm.serial, self._robot, self._chosen
        self._judged, self._around_stations, self._missing = None, [], ""
        self._frame = chain.base if chain else self._frame
        if chain is None:
            pictures = viewing.nothing(self._frame), viewing.nothing(self._frame)
        elif robot is None:
            pictures = viewing.nothing(self._frame), viewing.waiting_picture(chain, self._stations.postures)
        else:
            correction = robot.correction
            try:
                self._judged = self._stations.judged(correction, self._signals.tracks(correction.needs))
                before, moments = self._shapes, self._judged.moments if self._judged else ()
                self._shapes = {m.stamp: before.get(m.stamp) or tool_ellipsoid(correction, m) for m in moments}
                self._around_stations = viewing.around_stations(list(self._shapes.values()), chosen["arrow_scale"])
            except ModcalError as error:
                self._missing = str(error)
            scale, full = chosen["arrow_scale"], chosen["full_colour_m"]
            residuals = viewing.residual_picture(chain, self._judged, scale, full, self._change)
            pictures = residuals, viewing.stations_picture(correction, self._judged)
        self._residuals.publish(pictures[0])
        self._dots.publish(pictures[1])

    def _draw_posture(self) -> None:
        """Publish axes and ellipsoids where the arm stands; nothing of a posture that is not known now."""
        chain, joints, robot, scale = self._arm.serial, self._joints, self._robot, self._chosen["arrow_scale"]
        axes, present = viewing.nothing(self._frame), []
        try:
            if chain is None or joints is None:
                raise BadCommand("arm", "is not known", self._arm.trouble or _NO_ARM_YET)
            at = self._present(joints)
            calibrated = robot.correction.model.serial if robot else None
            nominal = robot.correction.calibration.nominal.serial if robot else chain
            axes = viewing.axes_picture(nominal, calibrated, at.q, scale, _LIFETIME)
            if robot is not None:
                present = [tool_ellipsoid(robot.correction, at)]
            self._unseen = ""
        except ModcalError as error:
            self._unseen = str(error)  # no refusal, and no line in the log: nothing was sent
        self._axes.publish(axes)
        around = self._around_stations
        self._ellipsoids.publish(viewing.uncertainty_picture(self._frame, around, present, scale, _LIFETIME))

    def _present(self, joints: JointInput) -> ArmState:
        """The moment that is now; raises BadCommand for joints that are not known now."""
        now = self._now()
        joints.require_fresh(now, self._chosen["timeout_s"])
        came = self._approach.direction if len(self._approach.direction) else np.zeros(len(joints.names))
        needs = self._robot.correction.needs if self._robot else ()
        at = joints.position.copy(), joints.velocity.copy(), came.copy(), joints.effort.copy()
        return ArmState(now, *at, self._signals.tracks(needs), self._approach.path.copy())

    def _report(self) -> list[ros.Status]:
        heard = ros.tracker_status(ros.subscription_status(self._inputs), self._inputs)
        return [heard, self._calibration_status(), self._view_status()]

    def _calibration_status(self) -> ros.Status:
        if self._robot is None:
            level = ros.WARN if self._calibration is None else ros.ERROR
            return ros.Status("calibration", level, self._refusals.recent("calibration") or self._refusal)
        calibration = self._robot.correction.calibration
        said = self._refusals.recent("calibration") or self._missing
        if not said and calibration.uncertainty is None:
            said = "has no uncertainty, so ellipsoids show scatter only: calibrate again"
        return ros.Status("calibration", ros.WARN if said else ros.OK, said or "in use", {"robot": calibration.robot})

    def _view_status(self) -> ros.Status:
        facts: dict[str, object] = {"stations": len(self._stations), "refused": self._refusals.counts.total()}
        if self._judged is not None:
            calibrated, nominal = self._judged.calibrated, self._judged.nominal
            facts["stations rejected"] = int(calibrated.rejected.sum())
            facts["residual, calibrated [mm]"] = f"{1e3 * viewing.rms(calibrated):.4f}"
            facts["residual, nominal [mm]"] = f"{1e3 * viewing.rms(nominal):.4f}"
        said = self._refusals.recent("joint_states", "tracker/pose", "tracker/point", "temperature") or self._unseen
        if self._judged is not None and self._judged.strangers:
            known = ", ".join(self._robot.correction.model.frames) if self._robot else ""
            strange = ", ".join(f"'{name}'" for name in self._judged.strangers)
            said = f"readings in frame {strange} are not shown: the calibration knows {known}: calibrate with them"
        return ros.Status("view", ros.WARN if said else ros.OK, said or "is drawn", facts)


def main() -> None:
    """Entry point of the executable."""
    ros.run(Viewer, rest=_REST)

"""``articulation_estimator``: how the object in the hand moves, learned while it is moved."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from geometry_msgs.msg import PointStamped, PoseStamped, PoseWithCovarianceStamped, WrenchStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from visualization_msgs.msg import Marker, MarkerArray

from modcal_core.articulation import NONE, JointModel, StampOrder, Tracker, TrackerSettings, TrackerState, describe
from modcal_core.errors import BadCommand, ModcalError
from modcal_core.geometry import Array, se3
from modcal_core.impedance import Load
from modcal_core.robots import Chain, chain_forward, read_chain
from modcal_msgs_py import (
    JointInput,
    fill_identity,
    fill_markers,
    fill_object_state,
    fill_object_status,
    fill_posed,
    nanoseconds,
    seen,
    status_values,
    wrench_numbers,
)
from modcal_nodes import ros

_POSES: dict[str, type] = {
    "tool_pose": PoseWithCovarianceStamped,
    "tracker/pose": PoseStamped,
    "tracker/point": PointStamped,
}
_MEASURED = ("tracker/pose", "tracker/point")
_JOINTS = "joint_states"
_HANDLE = "object_handle"
_SILENT = 1.0  # s without a pose, after which the estimate is said to be old
_RESTING = 25  # wrenches whose median is what the sensor shows when nobody pulls


class ArticulationEstimator(ros.ManagedNode):
    """Publishes the object as a one-joint URDF, its state, its axis, where it will be, and whether to trust it."""

    executable = "articulation_estimator"
    rest = 0.004  # s

    def _check(self, new: dict[str, Any]) -> None:
        if new["input"] not in (_JOINTS, *_POSES):
            known = f"use {_JOINTS}, {', '.join(_POSES)}"
            raise BadCommand(f"parameter input {new['input']!r}", "is not an input", known)

    def _serve(self) -> None:
        self.offer("~/reset", self._reset)

    def _configure(self) -> None:
        chosen = self._chosen
        self._tracker = Tracker(
            TrackerSettings(
                tolerance_m=chosen["tolerance_m"], still_m=chosen["still_m"], trust_after_m=chosen["trust_after_m"]
            ),
            measured=chosen["input"] in _MEASURED,
        )
        self._chain: Chain | None = None
        self._joints: JointInput | None = None
        self._names: frozenset[str] = frozenset()
        self._urdf, self._refusal = chosen["robot_description"], ""
        self._forget()
        self._rest: list[Array] = []
        self._offset = np.zeros(3)
        self._load = Load(chosen["tool_mass"])
        self._force = 0.0

        self._description = self.create_publisher(String, "~/object_description", ros.LATCHED)
        self._object = self.create_publisher(JointState, "~/object_state", 10)
        self._status_type, self._about = ros.interface("ObjectState"), ros.interface("Identity")()
        fill_identity(self._about, None, [chosen["input"]])
        self._status = self.create_publisher(self._status_type, "~/object_status", 10)
        self._expected = self.create_publisher(PoseStamped, "~/expected_pose", 10)
        self._axis = self.create_publisher(MarkerArray, "~/object_axis", 10)
        topic = chosen["input"]
        kind, take = (JointState, self._take_joints) if topic == _JOINTS else (_POSES[topic], self._take_pose)
        self._inputs = [
            self.hear(kind, topic, take, ros.FRESH, needed=True, single=True, replaced=self._soon),
            self.hear(WrenchStamped, "wrench", self._take_wrench, ros.FRESH),
        ]
        if topic == _JOINTS:
            needed = not chosen["robot_description"]
            take = self._take_description
            self._inputs.append(self.hear(String, "robot_description", take, ros.LATCHED, needed=needed))

    def _deactivate(self) -> None:
        """What is held is another object, or another grasp of it, when the node is active again."""
        if self._told is not None:
            self._description.publish(String(data=""))
        self._forget()
        self._rest.clear()

    def _forget(self) -> None:
        self._tracker.reset()
        self._state: TrackerState | None = None
        self._told: JointModel | None = None
        self._told_at = self._last = -np.inf
        self._exact = 0  # stamp of the pose that is followed [ns]
        self._order, self._heard = StampOrder(), time.monotonic()
        self._frame = ""
        self._turned: Array | None = None  # the gripper, when it was seen last
        self._ends = (0.0, 0.0)
        self._before = 0.0
        self._way = 1.0

    def _reset(self) -> tuple[bool, str]:
        self._forget()
        self._rest.clear()
        self._description.publish(String(data=""))
        self._health.publish()
        return True, "forgotten"

    def _take_description(self, message: String) -> None:
        if not self._chosen["robot_description"] and message.data != self._urdf:
            self._urdf, self._chain, self._refusal = message.data, None, ""
            self._forget()

    def _recognise(self, names: frozenset[str]) -> None:
        if not self._urdf or (names <= self._names and (self._chain or self._refusal)):
            return
        self._names |= names
        try:
            self._chain = read_chain(self._urdf, self._chosen["base"] or None, self._chosen["tip"] or None, self._names)
            self._refusal = ""
        except ModcalError as error:
            self._chain, self._refusal = None, str(error)
            return
        fill_identity(self._about, self._chain, [self._chosen["input"]])
        self._joints = JointInput(self._chain.names, self._chain.lower, self._chain.upper, self._chain.follows)

    def _take_joints(self, message: JointState) -> None:
        if self._chain is None:
            self._recognise(frozenset(message.name))
        if self._chain is None or self._joints is None:
            return
        now = self._now()
        self._joints.receive(message, now, self._chosen["timeout_s"])
        if not self._joints.complete:
            return
        self._joints.require_fresh(now, self._chosen["timeout_s"])
        if self._due(float(self._joints.stamps.min()), self._chain.base):
            T = chain_forward(self._chain, self._joints.position)
            self._exact = self._joints.stamp
            self._follow(T[:3, 3], T[:3, :3], float(self._joints.stamps.min()), self._chain.base)

    def _take_pose(self, message: Any) -> None:
        p, R, stamp = seen(message, self._chosen["input"])
        if self._due(stamp, message.header.frame_id):
            self._exact = nanoseconds(message.header.stamp)
            self._follow(p, R, stamp, message.header.frame_id)

    def _take_wrench(self, message: WrenchStamped) -> None:
        """Take a wrench: the pull is the force beyond the initial reading and the weight of the tool."""
        w = wrench_numbers(message)
        if not np.isfinite(w).all():
            raise BadCommand("wrench", "is not finite", "check the sensor")
        R = self._turned
        if R is None:  # the weight turns with the gripper, so where that points must be known, if there is a weight
            if self._load.mass > 0.0:
                return
            R = np.eye(3)
        left = (w - self._load.wrench(R))[:3]
        if len(self._rest) < _RESTING:
            self._rest.append(left)
            self._offset = np.median(self._rest, axis=0)
            return
        self._force = float(np.linalg.norm(left - self._offset))

    def _due(self, stamp: float, frame: str) -> bool:
        """Whether a pose of this time is wanted: not more of them than rate_hz; time that goes back restarts it.

        Raises BadCommand for one in another frame, or whose stamp lies alone, seconds from the others.
        """
        if self._frame and frame != self._frame:
            raise BadCommand(
                self._chosen["input"], f"is in frame {frame!r}, was in {self._frame!r}", "reset, or keep one"
            )
        before, order = self._order.last, self._order.judge(stamp, time.monotonic())
        if order == "alone":
            off = stamp - before
            said = f"its stamp is {abs(off):.1f} s {'ahead of' if off > 0.0 else 'behind'} the last"
            raise BadCommand(self._chosen["input"], said, "check the publisher's clock; this one is left out")
        if order == "restart":
            self.get_logger().warning("time has jumped back: the estimate restarts")
            self._forget()
            self._order.judge(stamp, time.monotonic())
        self._heard = time.monotonic()
        return order != "late" and not self._soon(stamp)

    def _soon(self, stamp: float) -> bool:
        return 0.0 <= stamp - self._last < 0.999 / self._chosen["rate_hz"]

    def _follow(self, p: Array, R: Array | None, stamp: float, frame: str) -> None:
        self._turned = R
        state = self._tracker.update(p, R, stamp, self._force > self._chosen["pull_n"])
        before = None if self._state is None else self._state.written
        self._state, self._frame, self._last = state, frame, stamp
        if state.written not in (None, before):
            self.get_logger().warning(f"{self._chosen['input']}, {state.written}")
        if state.event is not None or state.written != before:
            self._health.publish_if_changed()
        self._status.publish(fill_object_status(self._status_type(about=self._about), frame, self._exact, state))
        if state.model is None:
            return
        T = se3.transform(R if state.follows else None, p)
        self._tell_model(state, stamp)
        assert self._told is not None
        a = float(self._told.configuration(T if R is not None and state.follows else p))
        self._ends = (min(self._ends[0], a), max(self._ends[1], a))
        self._publish_state(self._told, a)

    def _tell_model(self, state: TrackerState, stamp: float) -> None:
        """Publish the model, when it says something else than the last one that was published."""
        assert state.model is not None
        soon = stamp - self._told_at < 1.0 / self._chosen["model_hz"]
        if self._told is not None and (soon or _alike(self._told, state.model)):
            return
        if self._told is None or self._told.kind != state.model.kind:
            self._ends = (0.0, 0.0)
        self._told, self._told_at = state.model, stamp
        text = describe(state.model, self._frame or "world", _HANDLE)
        self._description.publish(String(data=text))

    def _publish_state(self, model: JointModel, a: float) -> None:
        self._object.publish(fill_object_state(JointState(), self._frame, self._exact, a))
        length = max(model.length_per_unit, 1e-3)
        if abs(a - self._before) * length > 1e-3:  # which way the handle goes
            self._way, self._before = float(np.sign(a - self._before)), a
        ahead = self._chosen["lookahead_m"] / length
        T = model.pose(a + self._way * ahead) if model.moves else model.start
        self._expected.publish(fill_posed(PoseStamped(), self._frame, self._exact, T))
        assert self._state is not None
        reach = (self._ends[0] - ahead, self._ends[1] + ahead)
        if self._axis.get_subscription_count():  # a picture that nobody looks at is not drawn
            marks = fill_markers(MarkerArray(), Marker, self._frame, self._exact, model, reach, self._state.trusted)
            self._axis.publish(marks)

    def _report(self) -> list[ros.Status]:
        refused = self._refusals.recent()
        lines = [
            ros.subscription_status(self._inputs),
            ros.Status("inputs", ros.WARN if refused else ros.OK, refused or "nothing was refused"),
        ]
        if self._chosen["input"] == _JOINTS and self._chain is None:
            said = self._refusal or ("waiting for joint_states" if self._urdf else ros.NO_DESCRIPTION)
            lines.append(ros.Status("object", ros.ERROR, said))
        elif self._state is None:
            lines.append(ros.Status("object", ros.WARN, "waiting for poses"))
        else:
            said, starved = _said(self._state), self._starved(self._state)
            level = ros.WARN if self._state.event or self._state.written or starved else ros.OK
            lines.append(
                ros.Status("object", level, "; ".join(filter(None, (said, starved))), status_values(self._state))
            )
        return lines

    def _starved(self, state: TrackerState) -> str:
        topic, silent = self._chosen["input"], time.monotonic() - self._heard
        if silent > _SILENT:
            return f"{topic}: no usable pose for {silent:.0f} s, what is said of the object is as old"
        if state.sparse:
            return (
                f"{topic}: poses come {1e2 * state.apart_m:.0f} cm apart: pull slower, or publish more often, for a "
                "model to be trusted"
            )
        return ""


def _said(state: TrackerState) -> str:
    if state.event:
        return state.event
    if state.written is not None:
        return str(state.written)
    if state.kind == NONE:
        turn = "" if np.isnan(state.left[1]) else f" and {np.degrees(state.left[1]):.0f}°"
        return f"none of these: the best joint type leaves {1e3 * state.left[0]:.0f} mm{turn} of the path so far"
    return f"{state.kind}, trusted" if state.trusted else "not trusted yet"


def _alike(one: JointModel, other: JointModel) -> bool:
    """Whether two models say the same of the next decimetre, to a fifth of a millimetre and a tenth of a degree."""
    if one.kind != other.kind or one.oriented != other.oriented:
        return False
    a = np.array([-0.1, 0.0, 0.1]) / max(one.length_per_unit, 1e-3)
    T, S = one.pose(a), other.pose(a)
    shifted = float(np.abs(T[:, :3, 3] - S[:, :3, 3]).max())
    return shifted < 2e-4 and float(np.abs(T[:, :3, :3] - S[:, :3, :3]).max()) < 1.7e-3

"""An arm, an object and an estimator at the other end of the setpoint node's topics, and a witness of what it sends."""

from __future__ import annotations

import contextlib
import math
import time

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, WrenchStamped
from impedance.toy import PANDA, PERIOD, READY, ROOT, Toy, door
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from modcal_interfaces.msg import ObjectState
from nodes.polling import Polled
from nodes.processes import Wait, ask
from nodes.talking import LATCHED, Diagnostics
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from modcal_core.articulation.urdf import describe
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.kinematics import chain_forward
from modcal_msgs_py.readings import seconds, set_seconds

URDF = (ROOT / "examples" / "robots" / "panda.urdf").read_text()
WHO = "impedance_setpoint"
_PATIENCE, _UNANSWERED = 0.2, 10  # s of wall time for an answer; steps without one, after which none is waited for
_BEGIN = 1000.0  # s, when simulated time begins
SPEED, STALE, RATE = 1.5, 0.1, 250.0  # rad/s, s, Hz: the node's own defaults
_SLACK = PERIOD  # s


class PulledArm:
    """Publishes what an arm that holds a handle says, and the time, and follows joint references.

    Time is simulated and goes on when the node has answered, so that a busy machine changes nothing.
    """

    def __init__(self, node: Node, toy: Toy | None = None, trusts: float = 0.14, speaks: bool = True) -> None:
        self.node, self.toy, self.trusts, self.silent = node, toy or Toy(door()), trusts, False
        self.numb = False  # whether nothing is heard of the wrench
        self.frame = PANDA.tip  # that it is told in
        self.off: Array | None = (
            None  # where a corrector says that the tool is, from where its joints say; None: silent
        )
        self.health = Diagnostics(node, f"/{WHO}")
        self.poses: list[PoseStamped] = []
        self.references: list[JointTrajectoryPoint] = []
        self.trajectories: list[JointTrajectory] = []
        self.wrenches: list[WrenchStamped] = []
        self.stiffnesses: list[WrenchStamped] = []
        self.spoke = 0.0
        self.joints = node.create_publisher(JointState, "joint_states", 10)
        self.wrench = node.create_publisher(WrenchStamped, "wrench", 10)
        self.description = node.create_publisher(String, "robot_description", LATCHED)
        self.object = node.create_publisher(String, "object_description", LATCHED)
        self.status = node.create_publisher(ObjectState, "object_status", 10)
        self.tool = node.create_publisher(PoseWithCovarianceStamped, "tool_pose", 10)
        self._polled = Polled(node, period=None)
        for kind, topic, hear in (
            (JointTrajectoryPoint, "joint_references", self._follow),
            (JointTrajectory, "joint_trajectory", self.trajectories.append),
            (PoseStamped, "target_pose", self.poses.append),
            (WrenchStamped, "target_wrench", self.wrenches.append),
            (WrenchStamped, "target_stiffness", self.stiffnesses.append),
        ):
            self._polled.subscribe(kind, f"{WHO}/{topic}", hear)
        self.clock = node.create_publisher(Clock, "/clock", 10)
        self._time, self._answered, self._stepped = _BEGIN, 0.0, time.monotonic()
        if speaks:  # else it only asks: a clock that nobody answers goes as fast as it can
            self.description.publish(String(data=URDF))
            node.create_timer(0.5 * PERIOD, self.speak)

    def now(self) -> float:
        return self._time

    def _follow(self, point: JointTrajectoryPoint) -> None:
        self.references.append(point)
        self.toy.command = np.array(point.positions)
        self._answered = self._time

    def speak(self) -> None:
        self._polled.look()
        waits = PERIOD < self._time - self._answered < _UNANSWERED * PERIOD
        if waits and time.monotonic() - self._stepped < _PATIENCE:
            return
        self._stepped = time.monotonic()
        self._time += PERIOD
        self.toy.step()
        clock = Clock()
        set_seconds(clock.clock, self._time)
        self.clock.publish(clock)
        if not self.silent:
            q, w = self.toy.reading()
            self.spoke = self.now()
            self.joints.publish(self.state(q))
            if not self.numb:
                self.wrench.publish(self.felt(w))
            self.status.publish(self.told(self.toy.a >= self.trusts))
            if self.off is not None:
                self.tool.publish(self.corrected(q, self.off))

    def state(self, q: Array, names: tuple[str, ...] = PANDA.names, stamp: float | None = None) -> JointState:
        message = JointState(name=list(names), position=[float(x) for x in q])
        set_seconds(message.header.stamp, self.now() if stamp is None else stamp)
        return message

    def felt(self, w: Array, frame: str | None = None, stamp: float | None = None) -> WrenchStamped:
        message = WrenchStamped()
        message.header.frame_id = self.frame if frame is None else frame
        set_seconds(message.header.stamp, self.now() if stamp is None else stamp)
        f, m = message.wrench.force, message.wrench.torque
        f.x, f.y, f.z, m.x, m.y, m.z = (float(x) for x in w)
        return message

    def corrected(self, q: Array, off: Array) -> PoseWithCovarianceStamped:
        message = PoseWithCovarianceStamped()
        message.header.frame_id = PANDA.base
        set_seconds(message.header.stamp, self.now())
        p, o = message.pose.pose.position, message.pose.pose.orientation
        x, y, z, o.x, o.y, o.z, o.w = (float(v) for v in se3.to_pose(reached(q)))
        p.x, p.y, p.z = x + float(off[0]), y + float(off[1]), z + float(off[2])
        return message

    def told(self, trusted: bool, stamp: float | None = None) -> ObjectState:
        message = ObjectState(trusted=trusted)
        message.model.kind = "revolute"
        set_seconds(message.header.stamp, self.now() if stamp is None else stamp)
        return message

    def believe(self) -> None:
        """Say what the object is."""
        self.object.publish(String(data=describe(self.toy.truth, PANDA.base)))

    def change(self, wait: Wait, transition: int) -> bool:
        """Ask for a transition of the lifecycle; whether it was done."""
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool(ask(self.node, wait, ChangeState, f"{WHO}/change_state", request).success)

    def ask(self, wait: Wait, what: str) -> Trigger.Response:
        return ask(self.node, wait, Trigger, f"{WHO}/{what}")

    def ready(self, wait: Wait) -> None:
        """Configured, active, and heard."""
        assert self.change(wait, Transition.TRANSITION_CONFIGURE)
        assert self.change(wait, Transition.TRANSITION_ACTIVATE)
        self.believe()

    def pull(self, wait: Wait) -> None:
        """Ask until it pulls: it must have heard the arm before."""
        for _ in range(20):
            answer = self.ask(wait, "pull")
            if answer.success:
                return
            pause = time.monotonic() + 0.5
            wait(lambda pause=pause: time.monotonic() > pause, 5.0)
        raise AssertionError(answer.message)

    def again(self, wait: Wait, toy: Toy) -> None:
        """Another object in the hand, nothing heard of it yet, and the node active and still."""
        self.ask(wait, "stop")
        self.toy, self.silent, self.numb, self.off = toy, False, False, None
        for heard in (self.poses, self.references, self.trajectories, self.wrenches, self.stiffnesses):
            heard.clear()
        self.believe()

    def said(self) -> str:
        return str(self.health["pull"].message)


class Witness:
    """Looks at every setpoint that was sent since the last look. ``count``: how many there were."""

    def __init__(self, arm: PulledArm) -> None:
        self.arm, self.count = arm, 0
        self._last: tuple[float, Array] | None = None

    def look(self) -> None:
        """Assert that all of them are what an arm may be told."""
        arm = self.arm
        for message in arm.trajectories:
            self.count += 1
            stamp, (point,) = seconds(message.header.stamp), message.points
            q = np.array(point.positions)
            assert tuple(message.joint_names) == PANDA.names
            assert q.shape == (7,)
            assert np.isfinite(q).all()
            assert (q >= PANDA.lower).all()
            assert (q <= PANDA.upper).all()
            assert seconds(point.time_from_start) > 0.0
            if self._last is not None and 0.0 < stamp - self._last[0] <= 5.0 / RATE:
                assert (np.abs(q - self._last[1]) <= SPEED * (stamp - self._last[0]) * 1.001).all()
            self._last = stamp, q
        for point in arm.references:
            assert np.isfinite(point.positions).all()
            assert np.isfinite(point.velocities).all()
            assert (np.abs(np.array(point.velocities)) <= SPEED).all()
        for pose in arm.poses:
            p, o = pose.pose.position, pose.pose.orientation
            assert np.isfinite([p.x, p.y, p.z]).all()
            assert math.hypot(o.x, o.y, o.z, o.w) == 1.0 or abs(math.hypot(o.x, o.y, o.z, o.w) - 1.0) < 1e-6
            assert math.hypot(p.x, p.y, p.z) < 1.3
            assert pose.header.frame_id == PANDA.base
        for wrench in (*arm.wrenches, *arm.stiffnesses):
            f, m = wrench.wrench.force, wrench.wrench.torque
            numbers = np.array([f.x, f.y, f.z, m.x, m.y, m.z])
            assert np.isfinite(numbers).all()
            assert numbers.min() >= 0.0
            assert numbers.max() <= 5000.0
        for kept in (arm.trajectories, arm.references, arm.poses, arm.wrenches, arm.stiffnesses):
            kept.clear()

    def nothing_after(self, silence: float) -> None:
        """Assert that nothing was sent on what had been heard before a moment of silence [s]."""
        late = [seconds(m.header.stamp) - silence for m in self.arm.trajectories]
        assert not late or max(late) <= STALE + _SLACK


NASTY = (math.nan, math.inf, -math.inf, 1e300, -1e300, 1e12, 1e-300, 0.0, 4e-323, 1000.0, -7.0)
_KINDS = ("joints", "wrench", "object", "status", "tool", "description")


def hostile(arm: PulledArm, rng: np.random.Generator) -> None:
    """Publish one message that nobody in his right mind would send, on one of the topics that the node hears."""
    kind = _KINDS[rng.integers(5 if rng.random() < 0.995 else 6)]
    now = arm.now()
    stamp = float(rng.choice([now, now, now, 0.0, 1.0, now - 10.0, now + 10.0, 2e9]))
    if kind == "joints":
        q = READY + rng.normal(size=7) * rng.choice([0.0, 0.01, 1.0, 100.0])
        q[rng.integers(7)] = NASTY[rng.integers(len(NASTY))] if rng.random() < 0.6 else q[0]
        names = list(PANDA.names)
        if rng.random() < 0.3:
            names = list(rng.permutation([*names, "gripper", "", "panda_joint1"])[: rng.integers(9)])
        message = arm.state(q, tuple(str(n) for n in names), stamp)
        if rng.random() < 0.3:
            message.position = message.position[: rng.integers(8)]
        if rng.random() < 0.3:
            message.velocity = [NASTY[rng.integers(len(NASTY))]] * int(rng.integers(9))
        arm.joints.publish(message)
    elif kind == "wrench":
        w = rng.normal(size=6) * rng.choice([1.0, 1e3, 1e9])
        w[rng.integers(6)] = NASTY[rng.integers(len(NASTY))] if rng.random() < 0.6 else w[0]
        arm.wrench.publish(arm.felt(w, str(rng.choice([PANDA.tip, "", "camera", "panda_link0"])), stamp))
    elif kind == "object":
        good = describe(door(float(rng.uniform(0.05, 3.0)), float(rng.choice([-1.0, 1.0]))), PANDA.base)
        bad = ["", "<robot/>", "not xml", good[: rng.integers(len(good))], good.replace("0.", "nan"), "<" * 1000]
        arm.object.publish(String(data=good if rng.random() < 0.5 else str(rng.choice(bad))))
    elif kind == "status":
        message = arm.told(bool(rng.random() < 0.8), stamp)
        if rng.random() < 0.3:
            message.version, message.event = int(rng.integers(2**32)), "?" * int(rng.integers(200))
        arm.status.publish(message)
    elif kind == "tool":
        message = PoseWithCovarianceStamped()
        message.pose.pose.position.x = NASTY[rng.integers(len(NASTY))]
        arm.tool.publish(message)
    else:
        arm.description.publish(String(data=str(rng.choice(["", "<robot/>", "x" * 1000, URDF[:5000]]))))
        arm.description.publish(String(data=URDF))


def fuzz(arm: PulledArm, wait: Wait, rng: np.random.Generator, messages: int, burst: int = 200) -> tuple[int, int]:
    """(setpoints seen, pulls begun) while so many hostile messages are sent, among those of an honest arm.

    burst: how many of them come in a round, about.
    """
    witness, pulls, sent = Witness(arm), 0, 0
    rounds = 0
    while sent < messages:
        rounds += 1
        calm = rounds % 2 == 1  # some pulls are given time to begin, before anything hostile comes
        arm.silent = False
        arm.toy.__post_init__()  # closed again, the arm at its start
        arm.description.publish(String(data=URDF))
        arm.believe()
        soon = arm.now() + 0.1
        wait(lambda soon=soon: arm.now() > soon, 30.0)
        begun = arm.ask(wait, "pull").success
        pulls += begun
        if calm and begun:
            with contextlib.suppress(AssertionError):
                wait(lambda: len(arm.trajectories) > 50, 30.0)
        few = burst // 10 if calm else burst
        for _ in range(min(messages - sent, int(rng.integers(few, 5 * few)))):
            hostile(arm, rng)
            sent += 1
            if sent % 10 == 0:
                with contextlib.suppress(AssertionError):
                    wait(lambda: False, 0.002)
        witness.look()
        if rng.random() < 0.5:
            arm.silent = True
            silence = arm.spoke
            wait(lambda silence=silence: arm.now() > silence + 0.5, 60.0)
            witness.nothing_after(silence)
            arm.silent = False
        arm.ask(wait, "stop")
        witness.look()
    return witness.count, pulls


def reached(q: Array) -> Array:
    """The tool (4, 4) at a posture."""
    return chain_forward(PANDA, q)

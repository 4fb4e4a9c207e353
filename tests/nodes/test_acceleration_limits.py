"""The acceleration_limits node: bounds that MuJoCo's mechanics agree with, and none where they would be a guess."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from nodes.processes import Wait, beside, put
from nodes.talking import LATCHED, Diagnostics
from rclpy.node import Node
from robots.random_arms import Mujoco
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from modcal_core.geometry.so3 import Array
from modcal_core.robots.urdf import read_chain
from modcal_msgs_py.readings import seconds, set_seconds

pytestmark = pytest.mark.dds
ERROR, OK = DiagnosticStatus.ERROR, DiagnosticStatus.OK
URDF = (Path(__file__).resolve().parents[2] / "examples" / "robots" / "ur10.urdf").read_text()
CHAIN = read_chain(URDF)
EFFORT = np.array([330.0, 330.0, 150.0, 54.0, 54.0, 54.0])
AWAY = np.array([0.3, -1.2, 1.4, -0.8, 1.1, 0.2])
STATUS = "/acceleration_limits: limits"


class Rig:
    """An arm that says where it stands, and what the node says of it."""

    def __init__(self, node: Node, wait: Wait) -> None:
        self.node, self.wait = node, wait
        self.q, self.silent = AWAY.copy(), False
        self.reshape: Callable[[JointState], list[JointState]] = lambda message: [message]
        self.upper: list[JointTrajectory] = []
        self.lower: list[JointTrajectory] = []
        self.health = Diagnostics(node)
        self.states = node.create_publisher(JointState, "joint_states", 10)
        self.description = node.create_publisher(String, "robot_description", LATCHED)
        node.create_subscription(JointTrajectory, "acceleration_limits/upper", self.upper.append, 1000)
        node.create_subscription(JointTrajectory, "acceleration_limits/lower", self.lower.append, 1000)
        node.create_timer(0.02, self.speak)
        self.set = partial(put, node, wait, "acceleration_limits")

    def now(self) -> float:
        return 1e-9 * self.node.get_clock().now().nanoseconds

    def speak(self) -> None:
        if self.silent:
            return
        message = JointState(name=list(CHAIN.names), position=self.q.tolist(), velocity=[0.0] * 6)
        set_seconds(message.header.stamp, self.now())
        for said in self.reshape(message):
            self.states.publish(said)

    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of one moment that has yet to come."""
        begun = self.now()

        def pair() -> Any:
            low = {seconds(m.header.stamp): m for m in self.lower if seconds(m.header.stamp) > begun}
            return next(((low[t], m) for m in self.upper if (t := seconds(m.header.stamp)) in low), None)

        pairs = self.wait(pair, 60.0)
        for message in pairs:
            assert tuple(message.joint_names) == CHAIN.names
            (point,) = message.points
            assert not len(point.positions)  # nothing that a controller could take for a motion
            assert not len(point.velocities)
        low, high = (np.array(message.points[0].accelerations) for message in pairs)
        return low, high

    def says(self, level: bytes, words: str) -> None:
        """Wait until the node's status has this level and these words."""

        def said() -> bool:
            status = self.health.last.get(STATUS)
            return status is not None and status.level == level and words in status.message

        self.wait(said, 20.0)

    def recovers(self) -> None:
        """Wait until bounds come again, and the status knows."""
        self.bounds()
        self.wait(lambda: self.health.last[STATUS].level != ERROR, 20.0)

    def nothing_comes(self) -> None:
        """Of what is published from now on, no bound comes out; whether it lives is seen by its diagnostics."""
        self.wait(lambda: self.health.last[STATUS].level == ERROR, 20.0)
        count, at = len(self.upper), self.health.at[STATUS]
        self.wait(lambda: self.health.at[STATUS] > at + 1.5, 20.0)
        assert len(self.upper) == count


@contextmanager
def rig(tmp_path: Path, **parameters: Any) -> Iterator[Rig]:
    # a busy machine is late; what is too old here is so by seconds
    with beside(tmp_path, "acceleration_limits", timeout_s=1.5, rate_hz=20.0, **parameters) as (process, node, wait):
        made = Rig(node, wait)
        made.description.publish(String(data=URDF))
        yield made
        assert process.stop() == 0


def corners(low: Array, high: Array, truth: Mujoco, rng: np.random.Generator) -> Array:
    """Largest use of every drive at corners of the box, by MuJoCo."""
    choices = rng.integers(0, 2, (200, 6)).astype(bool)
    rest = np.zeros(6)
    return np.max([np.abs(truth.torque(AWAY, rest, np.where(c, high, low))) / EFFORT for c in choices], axis=0)


def test_bounds_hold_and_follow_the_payload(tmp_path: Path, rng: np.random.Generator) -> None:
    """In any order and company of joints; a payload set while it runs counts at once, one that is none is refused."""
    truth = Mujoco(URDF, CHAIN)
    with rig(tmp_path) as arm:
        low, high = arm.bounds()
        arm.says(OK, "limits are published")
        assert (low < 0.0).all()
        assert (high > 0.0).all()
        use = corners(low, high, truth, rng)
        assert use.max() < 1.0 + 1e-9

        def turned_and_accompanied(message: JointState) -> list[JointState]:
            message.name = ["gripper", *message.name[::-1]]
            message.position = [0.7, *list(message.position)[::-1]]
            message.velocity = []
            return [message]

        arm.reshape = turned_and_accompanied
        again = arm.bounds()
        assert np.allclose(again, (low, high), rtol=1e-9)

        assert not arm.set(payload_kg=5.0)
        loaded = arm.bounds()
        assert loaded[1][1] < 0.9 * high[1]
        assert arm.set(payload_kg=-1.0)
        assert "method 'guess': is neither coupled nor equivalent" in arm.set(method="guess")
        assert "rotor of joint 'elbow': is not of this arm" in arm.set(rotor=["elbow=1.0"])
        assert "read-only" in arm.set(tip="tool1")
        assert np.allclose(arm.bounds(), loaded, rtol=1e-6)  # what was refused changed nothing

        assert not arm.set(payload_kg=0.0, method="equivalent")
        arm.bounds()
        low, high = arm.bounds()
        for j in range(6):
            a = np.zeros(6)
            a[j] = high[j]
            assert truth.torque(AWAY, np.zeros(6), a)[j] == pytest.approx(EFFORT[j], rel=1e-9)


def test_no_bounds_where_they_would_be_a_guess(tmp_path: Path) -> None:
    """NaN, a missing joint, old stamps, silence, a load that is too much: nothing is published, and it is said."""
    with rig(tmp_path) as arm:
        arm.bounds()

        def with_positions(change: Callable[[list[float]], list[float]]) -> Callable[[JointState], list[JointState]]:
            def reshaped(message: JointState) -> list[JointState]:
                message.position = change(list(message.position))
                return [message]

            return reshaped

        def old(message: JointState) -> list[JointState]:
            set_seconds(message.header.stamp, arm.now() - 5.0)
            return [message]

        wrong: dict[str, Callable[[JointState], list[JointState]]] = {
            "NaN": with_positions(lambda q: [math.nan, *q[1:]]),
            "missing": lambda m: [JointState(header=m.header, name=m.name[:5], position=list(m.position)[:5])],
            "old": old,
        }
        for reshape in wrong.values():
            arm.reshape = reshape
            arm.says(ERROR, "joint_states of")  # they have grown old
            arm.nothing_comes()
            arm.reshape = lambda message: [message]
            arm.recovers()
        arm.silent = True
        arm.says(ERROR, "s off, 1.5 s is the limit")
        arm.nothing_comes()
        arm.silent = False
        arm.recovers()
        arm.q = np.zeros(6)  # stretched out
        assert not arm.set(payload_kg=60.0)
        arm.says(ERROR, "gravity, friction and speed need")
        arm.nothing_comes()


def test_what_the_description_does_not_say(tmp_path: Path) -> None:
    """No effort, no bounds, until somebody gives the torque; another description is another arm."""
    with rig(tmp_path, tip="tool0") as arm:
        arm.bounds()
        arm.description.publish(String(data=URDF.replace('effort="150"', 'effort="0"')))
        arm.says(ERROR, "drive of joint elbow_joint: the robot description states no effort")
        arm.nothing_comes()
        assert not arm.set(torque=["elbow_joint=150"])
        arm.recovers()
        arm.description.publish(String(data="<sdf/>"))
        arm.says(ERROR, "is <sdf>, not <robot>")

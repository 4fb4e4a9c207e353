"""The estimator: a door is shown to it, in order or with stamps that leap, and what it says is read by others' means."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from articulation.objects import Seen, ideal, noisy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, WrenchStamped
from modcal_interfaces.msg import ObjectState
from nodes.in_process import Pair, spun
from nodes.processes import Process, Wait, fresh_domain, listener, running
from nodes.talking import LATCHED, Diagnostics
from rclpy.node import Node
from rclpy.publisher import Publisher
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from modcal_core.articulation.urdf import read
from modcal_core.geometry import se3
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.urdf import read_chain
from modcal_msgs_py.commands import fill_pose
from modcal_msgs_py.readings import seconds, set_seconds
from modcal_nodes.nodes.articulation_estimator import ArticulationEstimator

pytestmark = pytest.mark.dds

UR10 = Path(__file__).resolve().parents[2] / "examples" / "robots" / "ur10.urdf"
NAME = "articulation_estimator"
STEP = 0.02  # s between poses, by their stamps


class Told:
    """Everything that the estimator says."""

    def __init__(self, node: Node) -> None:
        self.description, self.state, self.expected, self.markers = "", None, None, None
        self.status = ObjectState()
        node.create_subscription(String, f"{NAME}/object_description", self._describe, LATCHED)
        node.create_subscription(JointState, f"{NAME}/object_state", lambda m: setattr(self, "state", m), 10)
        node.create_subscription(PoseStamped, f"{NAME}/expected_pose", lambda m: setattr(self, "expected", m), 10)
        node.create_subscription(MarkerArray, f"{NAME}/object_axis", lambda m: setattr(self, "markers", m), 10)
        node.create_subscription(ObjectState, f"{NAME}/object_status", self._note, 100)

    def _describe(self, message: String) -> None:
        self.description = message.data

    def _note(self, message: ObjectState) -> None:
        self.status = message


def shown(seen: Seen, frame: str, begin: float) -> list[PoseStamped]:
    messages = []
    for i, pose in enumerate(se3.to_pose(se3.transform(seen.rotations, seen.positions))):
        message = PoseStamped()
        message.header.frame_id = frame
        set_seconds(message.header.stamp, begin + STEP * i)
        p, q = message.pose.position, message.pose.orientation
        p.x, p.y, p.z, q.x, q.y, q.z, q.w = (float(v) for v in pose)
        messages.append(message)
    return messages


def meet(node: Node, wait: Wait, *publishers: Publisher) -> None:
    """Until the estimator and these have found each other, both ways: what is said before may be lost."""
    said = Diagnostics(node)
    wait(lambda: all(p.get_subscription_count() and said.found(p.topic_name) for p in publishers), 15.0)


def say(publisher: Any, messages: list[Any], wait: Wait, told: Told) -> None:
    """Publish one after the other, each when the one before has been answered."""
    before = told.status.samples
    for k, message in enumerate(messages):
        publisher.publish(message)
        if k % 5 == 4:
            wait(lambda k=k: told.status.samples >= before + k - 2, 10.0)


def test_a_door_is_learned_told_and_forgotten(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    domain = fresh_domain()
    estimator = Process(NAME, domain, tmp_path, input="tracker/pose")
    with running(estimator), listener(domain) as (node, wait):
        told, diagnostics = Told(node), Diagnostics(node)
        publisher = node.create_publisher(PoseStamped, "tracker/pose", 100)
        meet(node, wait, publisher)
        seen = noisy(ideal("revolute", np.linspace(0.0, 1.0, 200), rng, 0.4), rng, 5e-4, 2e-3)
        begin = time.time()
        messages = shown(seen, "camera", begin)
        say(publisher, messages, wait, told)
        wait(lambda: told.status.trusted and told.status.model.kind == "revolute", 10.0)
        model = read(told.description)
        assert model.kind == "revolute"
        assert model.radius == pytest.approx(0.4, abs=0.01)
        assert abs(model.axis @ seen.axis) == pytest.approx(1.0, abs=2e-3)
        wait(lambda: round((seconds(told.state.header.stamp) - begin) / STEP) >= 195, 10.0)
        model = read(told.description)
        at = round((seconds(told.state.header.stamp) - begin) / STEP)
        assert model.position(told.state.position[0]) == pytest.approx(seen.positions[at], abs=5e-3)
        assert list(told.state.name) == ["object_joint"]
        assert told.state.header.frame_id == "camera"
        # 5 cm further along the circle, by trigonometry
        e = told.expected.pose.position
        arm = np.array([e.x, e.y, e.z]) - seen.point
        last = seen.positions[at] - seen.point
        assert np.linalg.norm(arm) == pytest.approx(0.4, abs=0.01)
        assert np.arccos(arm @ last / np.linalg.norm(arm) / np.linalg.norm(last)) == pytest.approx(0.05 / 0.4, abs=0.03)
        arrow = told.markers.markers[0].points
        along = np.array([arrow[1].x - arrow[0].x, arrow[1].y - arrow[0].y, arrow[1].z - arrow[0].z])
        assert abs(along @ seen.axis) / np.linalg.norm(along) == pytest.approx(1.0, abs=2e-3)

        bad = shown(seen, "camera", time.time() + 100.0)[:3]
        bad[0].pose.position.x = float("nan")
        bad[1].pose.orientation.w += 2.0
        bad[2].header.frame_id = "elsewhere"
        for message, words in zip(bad, ("is not finite", "quaternion has length", "is in frame"), strict=True):
            publisher.publish(message)
            wait(lambda words=words: diagnostics.said(f"/{NAME}: inputs", words), 10.0)
        assert told.status.trusted

        reset = node.create_client(Trigger, f"{NAME}/reset")
        assert reset.wait_for_service(15.0)
        answer = reset.call_async(Trigger.Request())
        wait(answer.done, 15.0)
        wait(lambda: told.description == "", 10.0)
        drawer = noisy(ideal("prismatic", np.linspace(0.0, 0.35, 200), rng), rng, 5e-4, 2e-3)
        told.status = ObjectState()
        say(publisher, shown(drawer, "table", time.time() + 50.0), wait, told)
        wait(lambda: told.status.trusted and told.status.model.kind == "prismatic", 10.0)
        assert told.state.header.frame_id == "table"
        assert estimator.stop() == 0


def test_an_arm_shows_the_handle_by_its_joints(tmp_path: Path) -> None:
    """The arm turns about its first joint, whose axis is z of the base: that is the hinge which must be found."""
    domain = fresh_domain()
    text = UR10.read_text()
    estimator = Process(NAME, domain, tmp_path)
    with running(estimator), listener(domain) as (node, wait):
        told, diagnostics = Told(node), Diagnostics(node)
        publisher = node.create_publisher(JointState, "joint_states", 100)
        wait(lambda: diagnostics.said(f"/{NAME}: object", "robot_description"), 15.0)
        describing = node.create_publisher(String, "robot_description", LATCHED)
        describing.publish(String(data=text))
        chain = read_chain(text, None, None, None)
        q = np.tile([0.0, -1.2, 1.9, -0.7, -1.57, 0.0], (1, 1))[0]
        angles = iter(np.linspace(0.0, 1.0, 4000))
        names = list(chain.names)[::-1]

        def turn() -> bool:
            q[0] = next(angles)
            message = JointState(name=[*names, "gripper"], position=[*q[::-1].tolist(), 0.3])
            message.header.stamp = node.get_clock().now().to_msg()
            publisher.publish(message)
            return told.status.trusted and told.status.model.kind == "revolute"

        wait(turn, 60.0)
        model = read(told.description)
        tip = chain_forward(chain, q[None])[0, :3, 3]
        assert model.radius == pytest.approx(np.hypot(tip[0], tip[1]), abs=0.02)
        assert abs(model.axis[2]) == pytest.approx(1.0, abs=1e-3)
        assert told.state.header.frame_id == chain.base


@pytest.mark.parametrize(("mass", "event"), [(2.0, ""), (0.0, "locked")])
def test_a_weight_that_turns_with_the_gripper_is_not_somebody_who_pulls(
    tmp_path: Path, mass: float, event: str
) -> None:
    """Turned on its side, a gripper of 2 kg feels 28 N of change; only who knows its weight knows that nobody pulls."""
    domain = fresh_domain()
    estimator = Process(NAME, domain, tmp_path, input="tracker/pose", tool_mass=mass)
    with running(estimator), listener(domain) as (node, wait):
        told = Told(node)
        poses = node.create_publisher(PoseStamped, "tracker/pose", 100)
        wrenches = node.create_publisher(WrenchStamped, "wrench", 100)
        meet(node, wait, poses, wrenches)
        tilt = np.concatenate([np.zeros(60), np.full(90, 0.5 * np.pi)])
        turned = Rotation.from_rotvec(np.stack([tilt, 0.0 * tilt, 0.0 * tilt], axis=1))
        still = Seen(
            np.tile([0.5, 0.0, 0.4], (150, 1)), turned.as_matrix(), "rigid", tilt, np.zeros(3), np.zeros(3), 0.0
        )
        extra = np.zeros(3)

        def hold(first: int, last: int) -> None:
            for k in range(first, last):
                felt = turned[min(k, 149)].inv().apply([0.0, 0.0, -2.0 * 9.80665]) + [1.0, -2.0, 0.5] + extra
                message = WrenchStamped()
                message.wrench.force.x, message.wrench.force.y, message.wrench.force.z = (float(x) for x in felt)
                wrenches.publish(message)
                pose = shown(still, "base", 100.0)[min(k, 149)]
                set_seconds(pose.header.stamp, 100.0 + STEP * k)
                poses.publish(pose)
                wait(lambda k=k: told.status.samples >= k, 10.0)

        hold(0, 150)
        assert told.status.event == event
        extra = np.array([0.0, 20.0, 0.0])  # and now somebody does
        hold(150, 220)
        assert told.status.event == "locked"


BEGIN, APART = 1.7e9, 0.1  # s


class Shown:
    """A drawer's poses, shown to the node one after the other, and what it says."""

    def __init__(self, pair: Pair) -> None:
        self.pair, self.status, self.health = pair, ObjectState(), {}
        self._publisher = pair.partner.create_publisher(PoseStamped, "tracker/pose", 10)
        self._silent = pair.partner.create_subscription(DiagnosticArray, "/diagnostics", self._heard, 50)
        name = pair.node.get_name()
        self._told = pair.partner.create_subscription(ObjectState, f"{name}/object_status", self._taken, 50)
        rng = np.random.default_rng(2)
        seen = noisy(ideal("prismatic", np.linspace(0.0, 0.3, 31), rng), rng, 2e-4, 1e-3)
        self.poses = se3.transform(seen.rotations, seen.positions)
        seen = noisy(ideal("revolute", np.linspace(0.0, 1.3, 120), rng, 0.5), rng, 2e-4, 2e-3)
        self.door = se3.transform(seen.rotations, seen.positions)
        pair.wait(
            lambda: self._publisher.get_subscription_count() and pair.node.count_subscribers(self._told.topic), 10.0
        )

    def _taken(self, message: ObjectState) -> None:
        self.status = message

    def _heard(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.health[status.name.split(": ")[-1]] = (status.level, status.message)

    def object(self) -> tuple[bytes, str]:
        """Level and words of what is said of the object."""
        return self.health.get("object", (b"", ""))

    def show(self, i: int, stamp: float) -> None:
        message = PoseStamped()
        message.header.frame_id = "camera"
        set_seconds(message.header.stamp, stamp)
        fill_pose(message.pose, self.poses[i])
        self._publisher.publish(message)

    def taken(self, count: int) -> None:
        """Wait until the node has learned from so many poses."""
        self.pair.wait(lambda: self.status.samples == count, 5.0)


@pytest.fixture
def drawer() -> Iterator[Shown]:
    with spun(ArticulationEstimator, input="tracker/pose") as pair:
        yield Shown(pair)


def test_one_pose_stamped_ten_seconds_ahead_wipes_nothing(drawer: Shown) -> None:
    for i in range(26):
        drawer.show(i, BEGIN + APART * i)
        drawer.taken(i + 1)
    assert drawer.status.trusted
    for leap in (10.0, -10.0):
        drawer.show(26, BEGIN + APART * 26 + leap)
        said = f"its stamp is {10.1 if leap > 0 else 9.9:.1f} s {'ahead of' if leap > 0 else 'behind'} the last"
        drawer.pair.wait(lambda said=said: said in drawer.health.get("inputs", (b"", ""))[1], 5.0)
    drawer.show(27, BEGIN + APART * 27)
    drawer.taken(27)
    assert drawer.status.trusted
    assert drawer.status.model.kind == "prismatic"


def test_a_left_handed_frame_is_said_by_name_and_nothing_is_trusted(drawer: Shown) -> None:
    drawer.poses = drawer.door
    drawer.poses[:, 1, 3] *= -1.0
    for i in range(len(drawer.poses)):
        drawer.show(i, BEGIN + APART * i)
        drawer.taken(i + 1)
    level, said = drawer.pair.wait(lambda: "left-handed" in drawer.object()[1] and drawer.object(), 8.0)
    assert level == DiagnosticStatus.WARN
    assert "with the sign of y reversed (a left-handed frame) a revolute one: correct the sign of y" in said
    assert not drawer.status.trusted
    assert "sign of y" in drawer.status.written


def test_poses_that_stop_coming_are_said(drawer: Shown) -> None:
    for i in range(8):
        drawer.show(i, BEGIN + APART * i)
        drawer.taken(i + 1)
    level, said = drawer.pair.wait(lambda: "no usable pose" in drawer.object()[1] and drawer.object(), 8.0)
    assert level == DiagnosticStatus.WARN
    assert "tracker/pose" in said

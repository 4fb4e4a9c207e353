"""Stamps that leap, poses that do not come, poses of another convention: in the test's process, over DDS."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from articulation.objects import ideal, noisy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nodes.in_process import Pair, spun

from modcal_core.geometry import se3
from modcal_msgs_py.commands import fill_pose
from modcal_msgs_py.readings import set_seconds
from modcal_nodes.nodes.articulation_estimator import ArticulationEstimator

pytestmark = pytest.mark.dds
BEGIN, STEP = 1.7e9, 0.1  # s


class Shown:
    """A drawer's poses, shown to the node one after the other, and what it says."""

    def __init__(self, pair: Pair) -> None:
        self.pair, self.status, self.health = pair, {}, {}
        self._publisher = pair.partner.create_publisher(PoseStamped, "tracker/pose", 10)
        self._silent = pair.partner.create_subscription(DiagnosticArray, "/diagnostics", self._heard, 50)
        name = pair.node.get_name()
        self._told = pair.partner.create_subscription(DiagnosticArray, f"{name}/object_status", self._taken, 50)
        rng = np.random.default_rng(2)
        seen = noisy(ideal("prismatic", np.linspace(0.0, 0.3, 31), rng), rng, 2e-4, 1e-3)
        self.poses = se3.transform(seen.rotations, seen.positions)
        seen = noisy(ideal("revolute", np.linspace(0.0, 1.3, 120), rng, 0.5), rng, 2e-4, 2e-3)
        self.door = se3.transform(seen.rotations, seen.positions)
        pair.wait(
            lambda: self._publisher.get_subscription_count() and pair.node.count_subscribers(self._told.topic), 10.0
        )

    def _taken(self, message: DiagnosticArray) -> None:
        self.status = {v.key: v.value for v in message.status[0].values}

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
        self.pair.wait(lambda: self.status.get("samples") == str(count), 5.0)


@pytest.fixture
def shown() -> Iterator[Shown]:
    with spun(ArticulationEstimator, input="tracker/pose") as pair:
        yield Shown(pair)


def test_one_pose_stamped_ten_seconds_ahead_wipes_nothing(shown: Shown) -> None:
    for i in range(26):
        shown.show(i, BEGIN + STEP * i)
        shown.taken(i + 1)
    assert shown.status["trusted"] == "true"
    for leap in (10.0, -10.0):
        shown.show(26, BEGIN + STEP * 26 + leap)
        said = f"its stamp is {10.1 if leap > 0 else 9.9:.1f} s {'ahead of' if leap > 0 else 'behind'} the last"
        shown.pair.wait(lambda said=said: said in shown.health.get("inputs", (b"", ""))[1], 5.0)
    shown.show(27, BEGIN + STEP * 27)
    shown.taken(27)
    assert (shown.status["trusted"], shown.status["kind"]) == ("true", "prismatic")


def test_a_left_handed_frame_is_said_by_name_and_nothing_is_trusted(shown: Shown) -> None:
    shown.poses = shown.door
    shown.poses[:, 1, 3] *= -1.0
    for i in range(len(shown.poses)):
        shown.show(i, BEGIN + STEP * i)
        shown.taken(i + 1)
    level, said = shown.pair.wait(lambda: "left-handed" in shown.object()[1] and shown.object(), 8.0)
    assert level == DiagnosticStatus.WARN
    assert "with the sign of y reversed (a left-handed frame) a revolute one: correct the sign of y" in said
    assert shown.status["trusted"] == "false"
    assert "sign of y" in shown.status["written"]


def test_poses_that_stop_coming_are_said(shown: Shown) -> None:
    for i in range(8):
        shown.show(i, BEGIN + STEP * i)
        shown.taken(i + 1)
    level, said = shown.pair.wait(lambda: "no usable pose" in shown.object()[1] and shown.object(), 8.0)
    assert level == DiagnosticStatus.WARN
    assert "tracker/pose" in said

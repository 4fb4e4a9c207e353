"""When an arm that measures itself may move at all, by what its controller is sent: no description without shapes, one
station at a time, a hold within the call that asks for it, and no station given up for where the arm stands."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from measuring.shaped import with_spheres
from nodes.processes import ROOT
from sensor_msgs.msg import JointState

from modcal_core.errors import BadCommand, BadRobot
from modcal_core.geometry.so3 import Array
from modcal_core.planning.route import TimedMotion
from modcal_core.planning.session import MEASURED, PLANNED, UNSEEN
from modcal_core.robots.urdf import read_chain
from modcal_nodes.measuring.sequence import Place, StationSequence
from modcal_nodes.ros.parameters import STATION_RUNNER

URDF = (ROOT / "examples" / "robots" / "ur10.urdf").read_text()
SHAPED = with_spheres(URDF)
NAMES = read_chain(URDF).names
MIDDLE, HALF = np.array([0.0, -1.2, 1.2, -0.5, 0.6, 0.3]), 0.35  # rad


def chosen(folder: Path, **others: Any) -> dict[str, Any]:
    """The parameters of the node, at a site that keeps the arm around its middle."""
    limits = {n: [float(m - HALF), float(m + HALF)] for n, m in zip(NAMES, MIDDLE, strict=True)}
    (folder / "site.yaml").write_text(yaml.safe_dump({"limits": limits}))
    defaults = {name: parameter.default for name, parameter in STATION_RUNNER.items()}
    return {**defaults, "out": str(folder / "out"), "site": str(folder / "site.yaml"), "measurement": "point"} | others


class Bench:
    """A sequence, what it sent and said, and joints that stand where they are told to. No ROS runs."""

    def __init__(self, folder: Path, urdf: str = SHAPED, **others: Any) -> None:
        self.sent: list[TimedMotion] = []
        self.said: list[str] = []
        self.q = MIDDLE.copy()
        self._begun: TimedMotion | None = None
        self._since = 0.0
        self.sequence = StationSequence(
            chosen(folder, **others), self.sent.append, lambda _, said: self.said.append(said), time.time
        )
        self.sequence.describe(urdf)
        self.sequence.activate()

    def until(self, condition: Callable[[], Any]) -> None:
        """Look every period, with fresh joints, until it is so."""
        end = time.monotonic() + 120.0
        while not condition():
            assert time.monotonic() < end, self.said
            self.hear()
            self.sequence.look()
            time.sleep(0.005)

    def follow(self) -> None:
        """Stand where the motion that was sent last has the arm by now."""
        motion = self.sent[-1]
        if self._begun is not motion:
            self._begun, self._since = motion, time.monotonic()
        self.q = motion.at(time.monotonic() - self._since)

    def hear(self) -> None:
        """The joints report where they are."""
        message = JointState(name=list(NAMES), position=self.q.tolist())
        now = time.time()
        message.header.stamp.sec, message.header.stamp.nanosec = int(now), int(1e9 * (now % 1.0))
        self.sequence.take_joints(message)

    def accept(self) -> None:
        """Look at the dry run and start."""
        self.until(lambda: any(said.startswith("dry run") for said in self.said))
        assert self.sequence.show("")[0]
        self.hear()
        self.sequence.start("")


def pending(bench: Bench) -> list[str]:
    place = bench.sequence._place
    assert place is not None
    return [s.state for s in place.session.stations]


@pytest.mark.slow
def test_a_description_without_shapes_is_refused_unless_that_is_accepted(tmp_path: Path) -> None:
    with pytest.raises(BadRobot, match="has no collision shapes"):
        Place(URDF, chosen(tmp_path))
    place = Place(URDF, chosen(tmp_path, no_self_collision=True))
    assert place.shapes is None
    assert "spheres along the links only" in place.dry_run(MIDDLE, 0.3)
    refused = Bench(tmp_path, URDF)
    refused.until(lambda: any("no collision shapes" in said for said in refused.said))
    assert not refused.sent


def test_nothing_is_sent_before_the_dry_run_was_looked_at_and_one_goal_at_a_time(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    with pytest.raises(BadCommand, match="there is no dry run yet"):
        bench.sequence.start("")
    bench.until(lambda: any(said.startswith("dry run") for said in bench.said))
    for _ in range(20):
        bench.hear()
        bench.sequence.look()
    assert not bench.sent
    with pytest.raises(BadCommand, match="nobody has looked at the dry run"):
        bench.sequence.start("")
    bench.accept()
    bench.until(lambda: bench.sent)
    with pytest.raises(BadCommand, match="it is measuring already"):
        bench.sequence.start("")
    for _ in range(20):  # the arm stands still at first, which is within what it may lag
        bench.hear()
        bench.sequence.look()
    assert len(bench.sent) == 1


@pytest.mark.slow
def test_a_hold_is_sent_within_the_call_that_asks_for_it(tmp_path: Path) -> None:
    for ask in (lambda s: s.stop(), lambda s: s.rest("deactivated"), lambda s: s.halt("a fault")):
        bench = Bench(tmp_path)
        bench.accept()
        bench.until(lambda b=bench: b.sent)
        bench.q = bench.q + 0.01
        bench.hear()
        count = len(bench.sent)
        ask(bench.sequence)
        assert len(bench.sent) == count + 1
        assert np.allclose(bench.sent[-1].end, bench.q)
        assert bench.sent[-1].t[-1] <= 0.2
        for _ in range(50):
            bench.hear()
            bench.sequence.look()
            time.sleep(0.005)
        assert len(bench.sent) == count + 1


@pytest.mark.slow
def test_a_station_that_the_instrument_does_not_see_is_passed_over(tmp_path: Path) -> None:
    """It is blind at the first station, and sees the second."""
    bench = Bench(tmp_path, speed_rad_s=3.0, settle_s=0.05, patience_s=0.5, readings=3, tolerance_rad=0.02)
    bench.accept()

    def more(count: int) -> bool:
        if bench.sent:
            bench.follow()
        if UNSEEN in pending(bench):
            bench.sequence.take_reading(np.array([1.0, 2.0, 3.0]), time.time())
        return sum(state != PLANNED for state in pending(bench)) >= count

    bench.until(lambda: more(2))
    assert sorted(state for state in pending(bench) if state != PLANNED) == [MEASURED, UNSEEN]
    assert any("was not seen by the instrument: it is passed over" in said for said in bench.said)


def test_after_a_rest_a_new_dry_run_has_to_be_accepted(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.accept()
    bench.until(lambda: bench.sent)
    bench.sequence.rest("deactivated")
    with pytest.raises(BadCommand, match="the node is not active"):
        bench.sequence.start("")
    bench.said.clear()
    bench.sequence.activate()
    bench.until(lambda: any(said.startswith("dry run") for said in bench.said))
    with pytest.raises(BadCommand, match="nobody has looked at the dry run"):
        bench.sequence.start("")
    assert len(bench.sent) == 2  # the motion and its hold


@pytest.mark.slow
def test_an_arm_that_stands_where_it_may_not_be_is_held_and_no_station_is_given_up(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.accept()
    bench.until(lambda: bench.sent)
    bench.sequence.stop()
    bench.q = MIDDLE + 1.5 * HALF * np.eye(6)[2]  # brought outside the site's limits by hand
    bench.hear()
    bench.said.clear()
    bench.sequence.start("")
    bench.until(lambda: any("posture of the arm" in said for said in bench.said))
    assert set(pending(bench)) == {PLANNED}
    bench.q = MIDDLE.copy()
    bench.hear()
    count = len(bench.sent)
    bench.sequence.start("")
    bench.until(lambda: len(bench.sent) > count)


def test_an_arm_that_stands_a_little_beside_a_limit_goes_on(tmp_path: Path) -> None:
    place = Place(SHAPED, chosen(tmp_path))
    place.kept.advise()
    start = MIDDLE + (HALF + 2e-3) * np.eye(6)[2]
    number = place.session.pending[0]
    motion = place.way(number, start, 0.3)
    assert motion is not None
    assert np.allclose(motion.q[0], start)
    with pytest.raises(BadRobot, match="outside limits"):
        place.way(number, start + 0.02 * np.eye(6)[2], 0.3)


def test_no_joint_is_faster_than_its_description_allows(tmp_path: Path) -> None:
    slow = SHAPED.replace('velocity="3.15"', 'velocity="0.02"')
    assert slow != SHAPED

    def top(urdf: str, folder: Path) -> Array:
        folder.mkdir()
        place = Place(urdf, chosen(folder))
        place.kept.advise()
        motion = place.way(place.session.pending[0], MIDDLE, 0.3)
        assert motion is not None
        return np.asarray(np.abs(motion.v).max(axis=0))

    before, after = top(SHAPED, tmp_path / "a"), top(slow, tmp_path / "b")
    assert before[2] > 0.05
    assert after[2] <= 0.02 + 1e-9  # the elbow has that limit

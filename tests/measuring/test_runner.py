"""When a measuring arm is held, when a station is read and when it is not seen; and collision by shapes."""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ET
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from measuring.shaped import with_spheres
from nodes.processes import ROOT

from modcal_core.errors import BadRobot
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.planning.route import TimedMotion, free_way, is_free, timed
from modcal_core.planning.session import MEASURED, UNSEEN, Station
from modcal_core.planning.site import Ball, Site, clearance, spheres_of
from modcal_core.robots.urdf import read_chain
from modcal_nodes.measuring.collision import CollisionModel
from modcal_nodes.measuring.runner import HELD, IDLE, Done, Hold, JointReport, Rules, Runner

GOAL = np.array([0.4, -0.2])
SPEED = np.full(2, 0.5)
PERIOD = 0.02
RULES = Rules(stale=0.2, off=0.05, arrived=0.01, settle=0.2, patience=1.0, readings=4)


def moving() -> tuple[Runner, TimedMotion]:
    runner = Runner(np.full(2, -1.0), np.full(2, 1.0), RULES)
    motion = timed([np.zeros(2), GOAL], SPEED)
    runner.begin(7, Station(GOAL), motion, 0.0)
    return runner, motion


def followed(
    runner: Runner, motion: TimedMotion, until: float, late: float = 0.0, read: bool = True
) -> tuple[float, object]:
    """The first answer of a runner whose arm follows so many seconds late, and when it came."""
    now = 0.0
    while now < until:
        now += PERIOD
        answer = runner.tick(now, JointReport(motion.at(max(now - late, 0.0)), now))
        if answer is not None:
            return now, answer
        if read:
            runner.take_reading(np.array([now, 2.0, 3.0]), 100.0 + now, now)
    return now, None


def test_a_station_is_read_once_the_arm_stands() -> None:
    runner, motion = moving()
    now, answer = followed(runner, motion, 10.0)
    assert isinstance(answer, Done)
    assert answer.number == 7
    assert answer.station.state == MEASURED
    assert answer.station.reading is not None
    # no reading from before the standstill, and four of them
    assert answer.station.reading[0] > motion.t[-1] + RULES.settle
    assert answer.station.stamp == pytest.approx(100.0 + answer.station.reading[0])
    assert now < motion.t[-1] + RULES.settle + 0.2
    assert np.allclose(answer.station.q, GOAL)
    assert answer.station.approach is not None
    assert answer.station.approach.tolist() == [1.0, -1.0]
    assert runner.phase == IDLE


def test_a_station_without_readings_is_not_seen() -> None:
    runner, motion = moving()
    now, answer = followed(runner, motion, 10.0, read=False)
    assert isinstance(answer, Done)
    assert answer.station.state == UNSEEN
    assert now > motion.t[-1] + RULES.settle + RULES.patience


def test_stale_joint_states_hold_the_arm_within_one_period_of_the_limit() -> None:
    runner, motion = moving()
    last = 0.3
    assert runner.tick(last, JointReport(motion.at(last), last)) is None
    assert runner.tick(last + RULES.stale, JointReport(motion.at(last), last)) is None
    answer = runner.tick(last + RULES.stale + PERIOD, JointReport(motion.at(last), last))
    assert isinstance(answer, Hold)
    assert "older than 0.2 s" in answer.why
    assert runner.phase == HELD
    assert runner.tick(1.0, JointReport(motion.at(1.0), 1.0)) is None  # and nothing more is sent


def test_an_arm_that_does_not_follow_is_held() -> None:
    runner, motion = moving()
    now, answer = 0.0, None
    while answer is None:
        now += PERIOD
        answer = runner.tick(now, JointReport(np.zeros(2), now))
    assert isinstance(answer, Hold)
    assert "from its way" in answer.why
    assert np.allclose(answer.q, 0.0)
    assert now < motion.t[-1]


def test_a_controller_that_lags_is_not_held() -> None:
    runner, motion = moving()
    _, answer = followed(runner, motion, 10.0, late=0.2)
    assert isinstance(answer, Done)


def test_a_joint_outside_its_limits_holds_the_arm() -> None:
    runner, _ = moving()
    answer = runner.tick(PERIOD, JointReport(np.array([1.1, 0.0]), PERIOD))
    assert isinstance(answer, Hold)
    assert "joint 1 is outside its limits" in answer.why


def test_an_arm_that_is_pushed_while_it_is_read_is_held() -> None:
    runner, motion = moving()
    now = 0.0
    while runner.phase != "reading":
        now += PERIOD
        assert runner.tick(now, JointReport(motion.at(now), now)) is None
    answer = runner.tick(now + PERIOD, JointReport(GOAL + 0.05, now + PERIOD))
    assert runner.phase == HELD
    assert answer is None  # nothing moves that could be stopped


def test_no_joint_is_faster_than_it_may_be_and_every_leg_ends_at_rest() -> None:
    motion = timed([np.zeros(2), np.array([0.7, 0.1]), GOAL], np.array([0.5, 0.2]))
    speed = np.abs(np.diff(motion.q, axis=0)) / np.diff(motion.t)[:, None]
    assert (np.abs(motion.v) <= np.array([0.5, 0.2]) + 1e-12).all()
    assert (speed <= np.array([0.5, 0.2]) + 1e-9).all()
    assert np.allclose(motion.v[-1], 0.0)
    assert np.allclose(motion.end, GOAL)


def test_a_way_that_is_not_free_leads_over_another_posture_or_is_none() -> None:
    def outside_a_disc(q: Array) -> np.ndarray:
        return np.asarray(np.linalg.norm(q - np.array([0.5, 0.0]), axis=1) > 0.2)

    start, goal = np.zeros(2), np.array([1.0, 0.0])
    assert not is_free(start, goal, outside_a_disc)
    over = np.array([[0.5, 0.05], [0.5, 0.6], [0.5, -5.0]])
    way = free_way(start, goal, outside_a_disc, over)
    assert way is not None
    assert way[1].tolist() == [0.5, 0.6]
    assert all(is_free(a, b, outside_a_disc) for a, b in pairwise(way))
    assert free_way(start, goal, outside_a_disc, over[:1]) is None


URDF = (ROOT / "examples" / "robots" / "ur10.urdf").read_text()
RADIUS = 0.06


def test_the_arm_touches_itself_where_balls_at_its_joints_do(rng: np.random.Generator) -> None:
    """Balls of links that are no neighbours: MuJoCo's contacts against distances by modcal's kinematics. Pairs that
    touch wherever the arm is are drawn that way, and are not looked at."""
    chain, radius = read_chain(URDF), 0.15
    model = CollisionModel(with_spheres(URDF, radius), chain.names, Site())
    behind = {j.get("name"): j.find("child").get("link") for j in ET.fromstring(URDF).findall("joint")}  # type: ignore[union-attr]
    links = [behind[name] for name in chain.names]
    pairs = [(i, j) for i, j in itertools.combinations(range(chain.n), 2) if j > i + 1]
    near, found = [], []
    for q in rng.uniform(-np.pi, np.pi, (150, chain.n)):
        T, at = np.eye(4), []
        for k in range(chain.n):
            T = T @ chain.origins[k] @ se3.exp(np.r_[np.zeros(3), chain.axes[k] * q[k]])
            at.append(T[:3, 3])
        near.append([np.linalg.norm(at[i] - at[j]) < 2.0 * radius for i, j in pairs])
        touching = {frozenset((t.one, t.other)) for t in model.touches(q)}
        found.append([frozenset((links[i], links[j])) in touching for i, j in pairs])
    expected = np.array(near)
    expected[:, expected.mean(axis=0) > 0.9] = False
    assert (np.array(found) == expected).all()
    assert expected.any(axis=1).sum() > 8


def test_floor_boxes_and_balls_are_kept_out_of() -> None:
    chain = read_chain(URDF)
    site = Site(
        floor=-0.5,
        boxes=(np.array([[0.5, -0.2, 0.0], [0.8, 0.2, 0.4]]),),
        obstacles=(Ball(np.array([0.0, 0.9, 0.6]), 0.2),),
        margin=0.01,
    )
    model = CollisionModel(with_spheres(URDF, RADIUS), chain.names, site)
    up = np.array([0.0, -np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0])
    assert model.free(up[None]).tolist() == [True]
    down = np.array([0.0, 1.2, 0.0, 0.0, 0.0, 0.0])
    assert "world" in {name for t in model.touches(down) for name in (t.one, t.other)}


def test_spheres_keep_out_of_boxes_as_well(rng: np.random.Generator) -> None:
    chain = read_chain(URDF)
    box = np.array([[0.2, -0.3, 0.1], [0.9, 0.3, 0.7]])
    site, bare = Site(boxes=(box,), link_radius=0.05), Site(link_radius=0.05)
    spheres = spheres_of(chain, site)
    q = rng.uniform(-np.pi, np.pi, (200, chain.n))
    with_box, without = clearance(spheres, site, q), clearance(spheres, bare, q)
    assert (with_box <= without + 1e-12).all()
    assert (with_box < without - 0.05).any()


def test_a_mesh_that_is_not_there_is_named(tmp_path: Path) -> None:
    text = with_spheres(URDF).replace('<sphere radius="0.05" />', '<mesh filename="package://ur/meshes/base.stl" />', 1)
    with pytest.raises(BadRobot, match=r"package://ur/meshes/base\.stl: is not a file"):
        CollisionModel(text, read_chain(URDF).names, Site(), tmp_path)

"""Trust is earned by the way that was travelled: not by how many poses came on it, nor by what their stamps say."""

from __future__ import annotations

import math

import numpy as np
import pytest
from articulation.objects import ideal, noisy

from modcal_core.articulation.joint_motion import Kind
from modcal_core.articulation.online import Tracker, TrackerState, Travel
from modcal_core.articulation.track import StampOrder
from modcal_core.geometry import so3

DEGREE = np.pi / 180.0
SPEED = 0.1  # m/s of the handle
RATES = (5.0, 10.0, 20.0, 50.0)  # Hz


def pulled(kind: Kind, hz: float, noise: float, seed: int, far: float = 0.4, radius: float = 0.5) -> list[TrackerState]:
    """States of a tracker that is shown the same pull, so many times a second."""
    rng = np.random.default_rng(seed)
    a = np.linspace(0.0, far / (1.0 if kind == "prismatic" else radius), round(far / SPEED * hz))
    seen = noisy(ideal(kind, a, rng, radius), rng, noise, 0.2 * DEGREE)
    tracker = Tracker()
    return [tracker.update(p, R, i / hz) for i, (p, R) in enumerate(zip(seen.positions, seen.rotations, strict=True))]


def earned(states: list[TrackerState], far: float = 0.4) -> float:
    """The way after which a model was trusted [m]."""
    return next((far * i / (len(states) - 1) for i, s in enumerate(states) if s.trusted), math.inf)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "noise"), [("prismatic", 1e-3), ("revolute", 2e-4)])
def test_the_same_pull_is_trusted_after_the_same_way_however_often_it_is_seen(kind: Kind, noise: float) -> None:
    ways = [earned(pulled(kind, hz, noise, 0)) for hz in RATES]
    assert max(ways) <= 1.2 * min(ways), ways
    assert max(ways) < 0.22


def test_nothing_is_trusted_before_twice_the_way_ahead_is_known() -> None:
    """However many poses come: a slow hand is not believed sooner."""
    assert earned(pulled("prismatic", 200.0, 1e-4, 1, far=0.18), far=0.18) > 0.14


def test_poses_that_come_too_far_apart_are_said() -> None:
    assert not any(s.sparse for s in pulled("revolute", 5.0, 1e-3, 2))
    last = pulled("revolute", 2.0, 1e-3, 2)[-1]
    assert last.sparse
    assert last.apart_m == pytest.approx(0.05, rel=0.3)


def test_one_stamp_far_ahead_or_behind_stands_alone() -> None:
    for leap in (10.0, -10.0):
        order = StampOrder()
        assert [order.judge(0.1 * i, 0.1 * i) for i in range(5)] == ["next"] * 5
        assert order.judge(0.5 + leap, 0.5) == "alone"
        assert [order.judge(0.6 + 0.1 * i, 0.6 + 0.1 * i) for i in range(3)] == ["next"] * 3
        assert order.last == pytest.approx(0.8)


def test_time_that_begins_again_is_believed_at_the_second_pose() -> None:
    order = StampOrder()
    assert [order.judge(100.0 + 0.1 * i, 0.1 * i) for i in range(3)] == ["next"] * 3
    assert [order.judge(3.0, 0.3), order.judge(3.1, 0.4), order.judge(3.2, 0.5)] == ["alone", "restart", "next"]


def test_a_pause_is_no_leap_and_a_gap_in_a_recording_is_believed_at_the_second_pose() -> None:
    order = StampOrder()
    order.judge(0.0, 0.0)
    assert order.judge(30.0, 30.0) == "next"
    assert [order.judge(60.0, 30.1), order.judge(60.1, 30.2)] == ["alone", "next"]


def test_a_pose_that_comes_late_is_left_out() -> None:
    order = StampOrder()
    order.judge(1.0, 1.0)
    assert order.judge(0.5, 1.1) == "late"
    assert order.last == 1.0


@pytest.mark.parametrize("step", [3e-4, 1.5e-3, 2.5e-3, 2e-2])
def test_each_millimetre_is_paid_for_and_no_pose_pays_for_its_neighbours(step: float) -> None:
    """What falls due from mark to mark is spread over the poses between; a pose never thinks for many."""
    travel, paid = Travel(), []
    for i in range(400):
        travel.stepped(step, 0.0)
        travel.come(np.array([step * i, 0.0, 0.0]), 1e-4)
        paid.append(travel.steps_due(0.1 * i))  # slow enough for all that falls due
    assert sum(paid) >= travel.path / 1e-3 - 5
    assert max(paid) <= math.ceil(step / 1e-3)


def test_what_was_owed_before_there_were_enough_poses_is_paid_at_once() -> None:
    travel = Travel()
    for i in range(6):
        travel.stepped(0.02, 0.0)
        travel.come(np.array([0.02 * i, 0.0, 0.0]), 1e-4)
    assert travel.steps_due(0.0) >= 60


def test_an_arm_that_flies_by_costs_no_more_than_a_quick_pull() -> None:
    """1.5 m/s, seen 200 times a second: some steps of computation a pose fall due, and are not made up for afterwards."""
    travel, seconds = Travel(), 4.0
    paid = []
    for i in range(round(200 * seconds)):
        travel.stepped(7.5e-3, 0.0)
        travel.come(np.array([7.5e-3 * i, 0.0, 0.0]), 1e-4)
        paid.append(travel.steps_due(i / 200))
    assert 200 * seconds <= sum(paid) <= 260 * seconds + 60
    rest = [travel.steps_due(seconds + i / 200) for i in range(200)]
    assert sum(rest) <= 80


def test_a_hand_that_keeps_its_orientation_is_worth_two_steps_a_millimetre() -> None:
    paid = []
    for doubly in (False, True):
        travel = Travel()
        travel.doubly = doubly
        for i in range(200):
            travel.stepped(1e-3, 0.0)
            travel.come(np.array([1e-3 * i, 0.0, 0.0]), 1e-4)
            paid.append(travel.steps_due(0.1 * i))
    assert sum(paid[200:]) == pytest.approx(2 * sum(paid[:200]), rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0.35, 0.47])
def test_a_door_is_known_within_a_pull_though_the_hand_keeps_its_orientation(
    radius: float, rng: np.random.Generator
) -> None:
    """A ball grasp: the rotations are those of a drawer. A pull gives up after 25 cm."""
    tracker, trusted = Tracker(), None
    for k in range(1, 500):
        a = 5e-4 * k / radius
        p = np.array([radius * np.sin(a), radius * (1.0 - np.cos(a)), 0.5]) + 1e-4 * rng.normal(size=3)
        state = tracker.update(p, so3.exp(2e-3 * rng.normal(size=3)), 0.02 * k, True)
        if state.trusted:
            trusted = 5e-4 * k
            break
    assert trusted is not None
    assert state.kind == "revolute"
    assert trusted < 0.235

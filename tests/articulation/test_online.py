"""While the handle moves: what is believed becomes right, is trusted when it predicts, and is none where no joint describes it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from articulation.objects import Array, Seen, ideal, noisy
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from modcal_core.articulation.joint_motion import Kind
from modcal_core.articulation.online import Tracker, TrackerState, Travel
from modcal_core.articulation.track import StampOrder
from modcal_core.errors import BadCommand
from modcal_core.geometry import so3

DEGREE = np.pi / 180.0


def pulled(kind: Kind, far: float, rng: np.random.Generator, count: int = 200, noise: float = 5e-4) -> Seen:
    return noisy(ideal(kind, np.linspace(0.0, far, count), rng, 0.4, 0.08), rng, noise, 0.2 * DEGREE)


def watch(
    tracker: Tracker, seen: Seen, oriented: bool = True, begin: float = 0.0, pull: bool = True
) -> list[TrackerState]:
    return [
        tracker.update(p, R if oriented else None, begin + 0.02 * i, pull)
        for i, (p, R) in enumerate(zip(seen.positions, seen.rotations, strict=True))
    ]


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0.25, 0.7])
def test_a_clean_door_is_at_no_moment_trusted_as_a_screw(radius: float) -> None:
    """A new guess of a hinge used to displace a better one, for it was weighed on more poses; then a screw won."""
    rng = np.random.default_rng(0)
    seen = noisy(ideal("revolute", np.linspace(0.0, 0.25 / radius, 416), rng, radius), rng, 1e-4, 0.02 * DEGREE)
    states = watch(Tracker(), seen)
    assert states[-1].trusted
    assert {s.kind for s in states if s.trusted} == {"revolute"}
    assert max(s.probabilities["screw"] for s in states if s.trusted) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "far", "oriented"), [("prismatic", 0.35, False), ("revolute", 1.0, True), ("screw", 2.6, False)]
)
def test_trust_comes_by_predicting_and_is_deserved(kind: Kind, far: float, oriented: bool) -> None:
    path = far * (1.0 if kind == "prismatic" else 0.4)
    seen = pulled(kind, far, np.random.default_rng(0), round(path / 0.0015))
    states = watch(Tracker(), seen, oriented)
    assert states[-1].kind == kind
    assert states[-1].trusted
    first = next(i for i, s in enumerate(states) if s.trusted)
    assert np.linalg.norm(seen.positions[first] - seen.positions[0]) < (0.5 if kind == "screw" else 0.3)
    # what is trusted is right 5 cm ahead, by the truth
    length = 1.0 if kind == "prismatic" else np.hypot(0.4, seen.pitch if kind == "screw" else 0.0)
    ahead = round(0.05 / length / (seen.a[1] - seen.a[0]))
    missed = []
    for i in range(first, len(states) - ahead):
        model = states[i].model
        p = seen.positions[i + ahead]
        missed.append(float(np.linalg.norm(model.position(model.configuration(p)) - p)))
    assert np.median(missed) < 6e-3
    assert not [s.event for s in states if s.event]


@pytest.mark.slow
def test_a_door_held_by_a_ball_is_learned_from_its_positions(rng: np.random.Generator) -> None:
    """The hand keeps its orientation while the door turns, which says nothing of the door."""
    seen = pulled("revolute", 1.0, rng)
    kept = noisy(ideal("rigid", np.zeros(200), rng), rng, 0.0, 0.1 * DEGREE)
    states = watch(Tracker(), Seen(seen.positions, kept.rotations, seen.kind, seen.a, seen.axis, seen.point, 0.0))
    last = states[-1]
    assert (last.kind, last.trusted, last.follows) == ("revolute", True, False)
    assert not last.model.oriented
    assert last.model.radius == pytest.approx(0.4, abs=0.02)


def test_before_anything_moves_nothing_is_trusted(rng: np.random.Generator) -> None:
    seen = noisy(ideal("rigid", np.zeros(150), rng), rng, 3e-4, 0.1 * DEGREE)
    states = watch(Tracker(), seen)
    assert not any(s.trusted for s in states)
    assert states[-1].event == "locked"
    assert not [s.event for s in watch(Tracker(), seen, pull=False) if s.event]


def test_a_door_that_jams_is_noticed(rng: np.random.Generator) -> None:
    a = np.concatenate([np.linspace(0.0, 0.7, 150), np.full(100, 0.7)])
    seen = noisy(ideal("revolute", a, rng, 0.4), rng, 3e-4, 0.1 * DEGREE)
    states = watch(Tracker(), seen)
    assert not [s.event for s in states[:150] if s.event]
    assert states[-1].event == "jammed"


@pytest.mark.slow
def test_a_handle_that_leaves_the_path_loses_trust_and_is_learned_anew(rng: np.random.Generator) -> None:
    """After 40° of a door the hand slips and slides off along a line."""
    door = pulled("revolute", 0.8, rng)
    off = door.positions[-1] - door.positions[-2]
    out = np.cross(door.axis, off)
    line = door.positions[-1] + np.linspace(0.002, 0.3, 150)[:, None] * out / np.linalg.norm(out)
    slid = Seen(line, np.tile(door.rotations[-1], (150, 1, 1)), "prismatic", np.zeros(150), out, line[0], 0.0)
    tracker = Tracker()
    assert watch(tracker, door)[-1].trusted
    after = watch(tracker, slid, begin=10.0)
    doubted = next(i for i, s in enumerate(after) if not s.trusted)
    assert np.linalg.norm(line[doubted] - line[0]) < 0.04
    assert not any(s.trusted for s in after[doubted : doubted + 40])
    assert "changed" in [s.event for s in after[:80]]
    assert after[-1].kind == "prismatic"


@pytest.mark.slow
def test_configuration_counts_from_the_beginning(rng: np.random.Generator) -> None:
    seen = pulled("revolute", 1.0, rng)
    last = watch(Tracker(), seen)[-1]
    assert abs(last.configuration) == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("pose", [([np.nan, 0, 0], None, 1.0), ([700.0, 0, 0], None, 1.0), ([0, 0], None, 1.0),
                                  ([0, 0, 0], None, np.nan), ([0, 0, 0], None, -1.0)])  # fmt: skip
def test_bad_poses_are_refused_and_change_nothing(pose: tuple[list[float], None, float]) -> None:
    tracker = Tracker()
    tracker.update(np.zeros(3), None, 0.0)
    with pytest.raises(BadCommand):
        tracker.update(*pose)
    assert tracker.update(np.zeros(3), None, 2.0).samples == 2


def watched(p: Array, R: Array | None) -> list[TrackerState]:
    tracker = Tracker()
    return [tracker.update(x, None if R is None else R[i], 0.05 * i) for i, x in enumerate(p)]


def waved(seed: int, n: int = 240) -> tuple[Array, Array]:
    """A hand that holds nothing, through seven places and orientations."""
    rng = np.random.default_rng(seed)
    knots, s = np.linspace(0.0, 1.0, 7), np.linspace(0.0, 1.0, n)
    p = CubicSpline(knots, rng.normal(0.0, 0.15, (7, 3)))(s) + rng.normal(0.0, 5e-4, (n, 3))
    return p, Rotation.from_rotvec(CubicSpline(knots, rng.normal(0.0, 0.4, (7, 3)))(s)).as_matrix()


@pytest.mark.slow
def test_a_hand_that_waves_is_none_and_hardly_ever_trusted() -> None:
    """A stretch of its way is an arc; once that has been left, trust takes as much more."""
    p, R = waved(3)
    states = watched(p, R)
    assert states[-1].kind == "none"
    assert states[-1].model is None
    assert states[-1].left[0] > 8e-3
    assert np.mean([s.trusted for s in states]) < 0.05


@pytest.mark.slow
def test_a_turn_that_does_not_go_with_the_path_is_none() -> None:
    """A handle that slides along a line and tips by 40° meanwhile: no drawer, no door, no screw."""
    rng, n = np.random.default_rng(1), 200
    p = np.outer(np.linspace(0.0, 0.4, n), [1.0, 0.0, 0.0]) + rng.normal(0.0, 3e-4, (n, 3))
    R = Rotation.from_rotvec(np.outer(40.0 * DEGREE * np.sin(np.linspace(0.0, 9.0, n)), [0.0, 1.0, 0.0])).as_matrix()
    states = watched(p, R)
    assert not states[-1].trusted or not states[-1].follows
    assert not any(s.trusted and s.follows for s in states[100:])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "far", "noise"), [("prismatic", 0.35, 2e-3), ("revolute", 0.9, 1e-4), ("screw", 1.6, 2e-3)]
)
def test_a_joint_is_at_no_moment_none(kind: Kind, far: float, noise: float) -> None:
    rng = np.random.default_rng(5)
    seen = noisy(ideal(kind, np.linspace(0.0, far, 150), rng, 0.4, 0.08), rng, noise, 0.5 * DEGREE)
    assert "none" not in {s.kind for s in watched(seen.positions, seen.rotations)}


def _arc(degrees: float, radius: float, n: int) -> tuple[Array, Array]:
    """From the origin along y, bending towards −x, and how far it has turned."""
    a = np.linspace(0.0, np.radians(degrees), n)
    return radius * np.stack([np.cos(a) - 1.0, np.sin(a), 0.0 * a], axis=1), a


@pytest.mark.slow
def test_a_hinge_of_two_pins_is_not_trusted_once_the_second_is_seen() -> None:
    """Each pin by itself is a hinge, and predicts; a door of the same path, and of the same noise, is trusted."""
    rng = np.random.default_rng(4)
    (first, a), (second, b) = _arc(38.0, 0.7, 110), _arc(40.0, 0.35, 80)
    turned = Rotation.from_rotvec([0.0, 0.0, a[-1]])
    p = np.concatenate([first, first[-1] + turned.apply(second)]) + rng.normal(0.0, 5e-4, (190, 3))
    R = Rotation.from_rotvec(np.outer(np.concatenate([a, a[-1] + b]), [0.0, 0.0, 1.0])).as_matrix()
    assert watched(p, R)[109].trusted
    assert not watched(p, R)[-1].trusted
    assert not watched(p, None)[-1].trusted
    whole, c = _arc(60.0, 0.6, 190)
    R = Rotation.from_rotvec(np.outer(c, [0.0, 0.0, 1.0])).as_matrix()
    assert watched(whole + rng.normal(0.0, 5e-4, (190, 3)), R)[-1].trusted


@pytest.mark.slow
def test_a_new_grasp_half_way_is_not_trusted_until_the_tracker_is_reset() -> None:
    rng, (p, a) = np.random.default_rng(3), _arc(80.0, 0.7, 200)
    p[100:] *= 0.82
    p[100:] += p[99] - p[100]
    R = Rotation.from_rotvec(np.outer(a, [0.0, 0.0, 1.0])).as_matrix()
    p += rng.normal(0.0, 4e-4, p.shape)
    assert watched(p, R)[99].trusted
    assert not watched(p, R)[-1].trusted
    assert watched(p[100:], R[100:])[-1].trusted


SPEED = 0.1  # m/s of the handle
RATES = (5.0, 50.0)  # Hz


def pulled_at(
    kind: Kind, hz: float, noise: float, seed: int, far: float = 0.4, radius: float = 0.5
) -> list[TrackerState]:
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
    ways = [earned(pulled_at(kind, hz, noise, 0)) for hz in RATES]
    assert max(ways) <= 1.2 * min(ways), ways
    assert max(ways) < 0.22


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


@pytest.mark.parametrize("step", [3e-4, 2.5e-3])
def test_each_millimetre_is_paid_for_and_no_pose_pays_for_its_neighbours(step: float) -> None:
    """What falls due from mark to mark is spread over the poses between; a pose never thinks for many."""
    travel, paid = Travel(), []
    for i in range(400):
        travel.stepped(step, 0.0)
        travel.come(np.array([step * i, 0.0, 0.0]), 1e-4)
        paid.append(travel.steps_due(0.1 * i))  # slow enough for all that falls due
    assert sum(paid) >= travel.path / 1e-3 - 5
    assert max(paid) <= math.ceil(step / 1e-3)


@pytest.mark.slow
def test_a_door_is_known_within_a_pull_though_the_hand_keeps_its_orientation(rng: np.random.Generator) -> None:
    """A ball grasp: the rotations are those of a drawer. A pull gives up after 25 cm."""
    radius, tracker, trusted = 0.47, Tracker(), None
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

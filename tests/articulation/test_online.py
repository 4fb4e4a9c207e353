"""While the handle moves: what is believed becomes right, is trusted when it predicts, and loses trust when it does not."""

from __future__ import annotations

import time

import numpy as np
import pytest
from articulation.objects import Seen, ideal, noisy
from scipy.spatial.transform import Rotation

from modcal_core.articulation.joint_motion import Kind
from modcal_core.articulation.online import Tracker, TrackerState
from modcal_core.errors import BadCommand

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
@pytest.mark.parametrize(("kind", "far"), [("prismatic", 0.35), ("revolute", 1.0), ("screw", 2.6)])
@pytest.mark.parametrize("oriented", [True, False])
def test_trust_comes_by_predicting_and_is_deserved(kind: Kind, far: float, oriented: bool) -> None:
    for seed in range(2):
        path = far * (1.0 if kind == "prismatic" else 0.4)
        seen = pulled(kind, far, np.random.default_rng(seed), round(path / 0.0015))
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
            assert model is not None
            p = seen.positions[i + ahead]
            missed.append(float(np.linalg.norm(model.position(model.configuration(p)) - p)))
        assert np.median(missed) < 6e-3
        assert not [s.event for s in states if s.event]


def test_a_door_held_by_a_ball_is_learned_from_its_positions(rng: np.random.Generator) -> None:
    """The hand keeps its orientation while the door turns, which says nothing of the door."""
    seen = pulled("revolute", 1.0, rng)
    kept = noisy(ideal("rigid", np.zeros(200), rng), rng, 0.0, 0.1 * DEGREE)
    states = watch(Tracker(), Seen(seen.positions, kept.rotations, seen.kind, seen.a, seen.axis, seen.point, 0.0))
    last = states[-1]
    assert (last.kind, last.trusted, last.follows) == ("revolute", True, False)
    assert last.model is not None
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


def test_gross_outliers_pass_without_a_trace(rng: np.random.Generator) -> None:
    seen = pulled("revolute", 1.0, rng)
    bad = rng.random(200) < 0.05
    bad[:20] = False
    p = seen.positions + bad[:, None] * rng.normal(0.0, 0.15, (200, 3))
    R = seen.rotations @ Rotation.from_rotvec(bad[:, None] * rng.normal(0.0, 0.5, (200, 3))).as_matrix()
    states = watch(Tracker(), Seen(p, R, seen.kind, seen.a, seen.axis, seen.point, 0.0))
    assert states[-1].kind == "revolute"
    assert states[-1].trusted
    assert not [s.event for s in states if s.event]


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


@pytest.mark.slow
def test_a_pose_costs_the_same_however_many_came_before(rng: np.random.Generator) -> None:
    """In the process's own time; the bound itself stands in bench, as a busy machine is not a failure."""
    seen = pulled("revolute", 1.2, rng, 1600)
    tracker, spent = Tracker(), []
    for i, (p, R) in enumerate(zip(seen.positions, seen.rotations, strict=True)):
        before = time.thread_time()
        tracker.update(p, R, 0.01 * i)
        spent.append(time.thread_time() - before)
    assert np.median(spent[1200:]) < 2.0 * np.median(spent[300:800])

"""What a check names, by readings that MuJoCo makes of an arm in which one thing has changed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from cells import Recorded, ur10
from checking.checks import FLOOR, Poses, checked, names, rms, twist

from modcal_core.calibration.store import Calibration, from_data, to_data
from modcal_core.checking.repair import nearest_covariance
from modcal_core.effects.effect import Effect
from modcal_core.effects.shapes import Shape
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array

pytestmark = pytest.mark.slow


def test_nothing_is_named_while_nothing_has_changed(cell: tuple[Recorded, Calibration]) -> None:
    for seed in range(8):
        found, _, _ = checked(cell, lambda q, world: world(q), seed)
        assert found.status == "unchanged", found.sentence
        assert found.advice.action == "nothing"
        assert found.repaired is None
        assert all(3.0 * n.mm > 1e3 * FLOOR / 3.0 for n in found.noticed)  # ten stations do not show what is far below


@pytest.mark.parametrize(
    ("name", "seen"),
    [
        (("base", "base"), lambda q, world: twist(1.5e-4, (1, -1, 1, 0.5, 1, -0.5)) @ world(q)),
        (("tool", "tool"), lambda q, world: world(q) @ twist(2e-4, (1, 0.5, -1, 1, -1, 1))),
        (("joint_zero", "elbow_joint"), lambda q, world: world(q + 5e-4 * np.eye(6)[2])),
        (("tracker_scale", "tracker"), lambda q, world: scaled(world(q), 1.0 + 4e-4)),
    ],
)
def test_a_change_is_named_and_repaired(
    cell: tuple[Recorded, Calibration], name: tuple[str, str], seen: Callable[[Array, Poses], Array]
) -> None:
    for seed in range(3):
        found, _, _ = checked(cell, seen, seed)
        assert names(found) == {name}, found.sentence
        change = found.changes[0]
        assert change.moved_mm[1] <= change.moved_mm[0] <= change.moved_mm[2]
        assert found.repaired is not None
        # against the world, at postures that the check has not seen
        q = np.random.default_rng(77).uniform(-2.5, 2.5, (100, 6))
        truth = seen(q, cell[0].world.tool_in_tracker)
        before, after = (rms(model.predict(q), truth) for model in (cell[1], found.repaired))
        if name[0] != "tracker_scale":  # predictions are where the tool is, not what a wrong metre reads
            assert after < 0.5 * before
            assert after < 0.8 * FLOOR


def test_a_turn_that_moves_nothing_is_told_in_degrees(cell: tuple[Recorded, Calibration]) -> None:
    found, _, _ = checked(cell, lambda q, world: world(q) @ twist(2e-3, (0, 0, 0, 0, 0, 1)))
    (change,) = found.changes
    assert change.turned_deg is not None
    assert change.turned_deg == pytest.approx(np.degrees(2e-3), rel=0.1)
    assert f"{change.turned_deg:.3f}° RMS at the tool" in change.sentence


def scaled(T: Array, factor: float) -> Array:
    """The poses with their positions times a factor."""
    out = T.copy()
    out[:, :3, 3] *= factor
    return out


def test_a_size_lies_in_its_interval(cell: tuple[Recorded, Calibration]) -> None:
    zero = 6e-4
    inside = 0
    for seed in range(10):
        found, _, _ = checked(cell, lambda q, world: world(q + zero * np.eye(6)[1]), seed)
        (size,) = found.changes[0].sizes
        assert size.unit == "mrad"
        inside += size.low <= 1e3 * zero <= size.high
    assert inside >= 8  # of ten intervals of 95 %, fewer once in ninety times


def test_the_claim_covers_what_a_repair_misses_by(cell: tuple[Recorded, Calibration]) -> None:
    move = twist(2e-4, (1, -1, 1, 0.5, 1, -0.5))
    fresh = np.random.default_rng(79).uniform(-2.5, 2.5, (100, 6))
    truth = move @ cell[0].world.tool_in_tracker(fresh)
    ratios = []
    for seed in range(8):
        found, _, _ = checked(cell, lambda q, world: move @ world(q), seed)
        assert found.repaired is not None
        assert found.report.claim is not None
        missed = np.linalg.norm(found.repaired.predict(fresh)[:, :3, 3] - truth[:, :3, 3], axis=1)
        ratios.append(found.report.claim.mm["p95"].ci95[1] / (1e3 * np.percentile(missed, 95)))
    assert np.sum(np.array(ratios) >= 1.0) >= 7
    assert np.median(ratios) < 3.0


def test_of_two_curves_of_one_gear_the_one_that_grew_is_repaired(cell: tuple[Recorded, Calibration]) -> None:
    waves = [
        Effect(
            "gear_harmonic", "elbow_joint", "axis", "position:elbow_joint", shape, values, 1e-6 * np.ones(len(values))
        )
        for shape, values in (
            (Shape("turn", {"cycles": 1.0}), np.array([1e-3, 0.0])),
            (Shape("turn", {"cycles": 2.0}), np.array([5e-4, 2e-4])),
        )
    ]
    known = cell[1].uncertainty
    assert known is not None
    known = replace(known, covariance=np.pad(known.covariance, (0, 4)))
    two = replace(cell[1], calibrated=cell[1].calibrated.with_effects(tuple(waves)), rivals=((), ()), uncertainty=known)

    def seen(q: Array, world: Poses) -> Array:
        turn = 1e-3 * np.sin(q[:, 2]) + 1.8 * (5e-4 * np.sin(2.0 * q[:, 2]) + 2e-4 * np.cos(2.0 * q[:, 2]))
        return world(q + np.outer(turn, np.eye(6)[2]))

    found, _, _ = checked((cell[0], two), seen)
    assert names(found) == {("gear", "elbow_joint")}
    assert found.repaired is not None
    grown = [np.linalg.norm(e.amplitudes) for e in found.repaired.calibrated.effects]
    assert grown[0] == pytest.approx(1e-3)
    assert grown[1] == pytest.approx(1.8 * np.hypot(5e-4, 2e-4), rel=0.1)


def test_a_gear_is_named_and_its_wave_found(cell: tuple[Recorded, Calibration]) -> None:
    def seen(q: Array, world: Poses) -> Array:
        return world(q + np.outer(1e-3 * np.sin(101 * q[:, 3] + 0.4), np.eye(6)[3]))

    found, _, _ = checked(cell, seen)
    assert names(found) == {("gear", "wrist_1_joint")}
    assert found.repaired is not None
    (wave,) = found.repaired.calibrated.effects
    assert wave.shape.settings["cycles"] == pytest.approx(101.0, abs=0.3)
    q = np.random.default_rng(78).uniform(-2.5, 2.5, (100, 6))
    truth = seen(q, cell[0].world.tool_in_tracker)
    assert rms(found.repaired.predict(q), truth) < 0.5 * rms(cell[1].predict(q), truth)


def test_a_curve_without_a_form_asks_for_stations_along_it(cell: tuple[Recorded, Calibration]) -> None:
    wander = np.random.default_rng(5)  # another error at every posture

    found, q, _ = checked(
        cell, lambda q, world: world(q + np.outer(8e-4 * wander.standard_normal(len(q)), np.eye(6)[3]))
    )
    assert names(found) == {("gear", "wrist_1_joint")}
    assert found.advice.action == "add_stations"
    assert found.repaired is None
    assert np.ptp(found.advice.stations[:, 3]) > np.ptp(q[:, 3])


def test_noise_is_not_taken_for_a_move(cell: tuple[Recorded, Calibration]) -> None:
    for seed in range(4):
        found, _, _ = checked(cell, lambda q, world: world(q), seed, noise=3.0)
        assert names(found) == {("tracker_noise", "tracker")}, found.sentence
        assert found.advice.action == "check_instrument"


def test_two_changes_are_both_named(cell: tuple[Recorded, Calibration]) -> None:
    move = twist(4e-4, (1, -1, 1, 0.5, 1, -0.5))
    found, _, _ = checked(cell, lambda q, world: move @ world(q + 8e-4 * np.eye(6)[2]), count=14)
    assert names(found) == {("base", "base"), ("joint_zero", "elbow_joint")}, (found.sentence, found.status)


def test_a_large_move_is_named(cell: tuple[Recorded, Calibration]) -> None:
    move = se3.exp([0.2, -0.1, 0.05, 0.3, 0.2, -0.4])
    found, _, _ = checked(cell, lambda q, world: move @ world(q))
    assert names(found) == {("base", "base")}
    assert found.advice.action == "refit_base"
    assert found.after[0] is not None
    assert found.after[0] < 2e3 * FLOOR


def test_one_wrong_reading_is_set_aside(cell: tuple[Recorded, Calibration]) -> None:
    def seen(q: Array, world: Poses) -> Array:
        T = world(q)
        T[4, :3, 3] += [2e-3, -1e-3, 1e-3]
        return T

    found, _, _ = checked(cell, seen)
    assert found.status == "unchanged"
    assert len(found.aside) == 1


def test_a_repaired_calibration_is_read_back_and_checks_clean(cell: tuple[Recorded, Calibration]) -> None:
    tool = twist(3e-4, (1, 0.5, -1, 1, -1, 1))
    found, _, _ = checked(cell, lambda q, world: world(q) @ tool)
    assert found.repaired is not None
    again = from_data(to_data(found.repaired))
    after, _, _ = checked((cell[0], again), lambda q, world: world(q) @ tool, seed=5)
    assert after.status == "unchanged", after.sentence
    # what ten stations say of a tool is less than what eighty did, and the covariance says so
    assert again.uncertainty is not None
    assert cell[1].uncertainty is not None
    assert again.uncertainty.covariance.trace() > cell[1].uncertainty.covariance.trace()


def test_a_gear_that_moves_readings_as_far_as_another_robot_is_named(cell: tuple[Recorded, Calibration]) -> None:
    """Five degrees of a gear, which base and tool fitted again leave more of than any arm of the same make."""
    for joint in (0, 5):

        def seen(q: Array, world: Poses, j: int = joint) -> Array:
            return world(q + np.outer(np.radians(5.0) * np.sin(100 * q[:, j] + 0.3), np.eye(6)[j]))

        found, q, T = checked(cell, seen)
        assert names(found) == {("gear", ur10().names[joint])}, found.sentence
        moved = rms(cell[0].world.tool_in_tracker(q), T)
        assert found.changes[0].moved_mm[0] == pytest.approx(1e3 * moved, rel=0.05)


def test_zeros_that_were_set_anew_are_named(cell: tuple[Recorded, Calibration]) -> None:
    found, _, _ = checked(cell, lambda q, world: world(q + np.radians(3.0) * (np.eye(6)[1] + np.eye(6)[4])))
    assert names(found) == {("joint_zero", "shoulder_lift_joint"), ("joint_zero", "wrist_2_joint")}


def test_a_covariance_with_a_direction_below_nothing_becomes_the_nearest_that_has_none(
    rng: np.random.Generator,
) -> None:
    """One that may be stays as it is."""
    root = rng.standard_normal((6, 6)) * np.array([1e-4, 1e-3, 1e-2, 1.0, 1.0, 1.0])[:, None]
    good = root @ root.T
    assert nearest_covariance(good) == pytest.approx(good, rel=1e-9, abs=1e-18)
    bad = good - 1.2 * np.outer(root[:, 0], root[:, 0]) / (root[:, 0] @ np.linalg.solve(good, root[:, 0]))
    scale = np.sqrt(np.diag(good))
    assert np.linalg.eigvalsh(bad / np.outer(scale, scale))[0] < 0.0
    restored = nearest_covariance(bad) / np.outer(scale, scale)
    assert np.linalg.eigvalsh(restored)[0] > -1e-9

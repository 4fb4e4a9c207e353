"""What people put back by hand is repaired before the arm, where both move the readings alike."""

from __future__ import annotations

import numpy as np
import pytest
from cells import NOISE_M, Recorded, ur10
from checking.checks import Poses, checked, names, rms

from modcal_core.calibration.store import Calibration
from modcal_core.checkup import Checked
from modcal_core.effects.placements import AS_LIKELY, one_motion, put_back_first
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_core.public import check
from modcal_core.report.checkup import checkup_data

FIRST, LAST = "shoulder_pan_joint", "wrist_3_joint"
slow = pytest.mark.slow


def about(joint: int, size: float) -> Array:
    return size * np.eye(6)[joint]


def of_points(calibration: Calibration, q: Array, T: Array) -> Checked:
    p = T[:, :3, 3] + NOISE_M * np.random.default_rng(5).standard_normal((len(q), 3))
    return check(
        calibration, Samples.from_arrays(q, points=p, names=ur10().names, stamps=1e6 + 5.0 * np.arange(len(q)))
    )


def test_what_explains_as_much_outside_the_arm_is_put_back_first() -> None:
    outside, likely = [True, True, False, False], np.array([-9.0, -2.0, 0.0, 1.0])
    assert put_back_first(2, outside, likely) == 1
    assert put_back_first(3, outside, likely) == 1
    assert put_back_first(0, outside, likely) == 0
    assert put_back_first(3, outside, likely - np.array([0.0, AS_LIKELY, 0.0, 0.0])) == 3
    assert put_back_first(0, [False], np.zeros(1)) == 0
    assert (one_motion("base"), one_motion("tool"), one_motion(LAST)) == (("tracker",), ("target",), ())


@slow
def test_a_turn_about_the_first_axis_is_the_base_or_the_tracker(cell: tuple[Recorded, Calibration]) -> None:
    found, _, _ = checked(cell, lambda q, world: world(q + about(0, 5e-4)))
    assert names(found) == {("base", "base")}
    assert found.changes[0].same_as[:2] == ("tracker", f"zero of {FIRST}")
    assert found.changes[0].alike == "poses"
    assert found.status == "changed"  # the repaired poses are the same
    assert "The base or the tracker has moved" in found.sentence


@slow
def test_a_turn_about_the_last_axis_is_the_tool_or_the_target(cell: tuple[Recorded, Calibration]) -> None:
    found, _, _ = checked(cell, lambda q, world: world(q + about(5, 1e-3)))
    assert names(found) == {("tool", "tool")}
    assert found.changes[0].same_as[:2] == ("target", f"zero of {LAST}")
    assert found.changes[0].alike == "poses"


@slow
@pytest.mark.parametrize("count", [8, 10, 20])
def test_points_turn_no_flange(cell: tuple[Recorded, Calibration], count: int) -> None:
    """A target that was mounted a millimetre further round the last axis: the arm would be turned by degrees."""
    world, calibration = cell
    q = np.random.default_rng(count).uniform(-2.5, 2.5, (count, 6))
    at = world.world.tool_in_tracker
    angle = 1e-3 / (rms(at(q + about(5, 1e-3)), at(q)) / 1e-3)
    moved = at(q + about(5, angle))
    found = of_points(calibration, q, moved)
    assert names(found) == {("tool", "tool")}
    assert {"target", f"zero of {LAST}"} <= set(found.changes[0].same_as)
    assert found.changes[0].alike == "positions"
    assert "orientations" in found.sentence
    (said,) = checkup_data(found)["changes"]
    assert (said["same_at_every_posture"], said["same_orientation"]) == (True, False)
    assert found.repaired is not None
    fresh = np.random.default_rng(6).uniform(-2.5, 2.5, (100, 6))
    old, new = calibration.predict(fresh), found.repaired.predict(fresh)
    assert np.abs(so3.log(np.swapaxes(old[:, :3, :3], 1, 2) @ new[:, :3, :3])).max() < 1e-9
    assert rms(new, at(fresh + about(5, angle))) < 3.0 * NOISE_M


@slow
def test_a_zero_that_nothing_outside_explains_is_named(cell: tuple[Recorded, Calibration]) -> None:
    found, _, _ = checked(cell, lambda q, world: world(q + about(2, 5e-4)))
    assert names(found) == {("joint_zero", "elbow_joint")}


@slow
def test_nothing_is_left_that_made_up_for_a_wrong_name(cell: tuple[Recorded, Calibration]) -> None:
    """A tracker that was turned on the spot: a zero of the first joint explains it beside a scale, the base alone."""
    turn = se3.exp([0.0, 0.0, 0.0, 0.0, 0.0, 2e-3])

    def seen(q: Array, world: Poses) -> Array:
        return turn @ world(q)

    for seed in range(3):
        found, _, _ = checked(cell, seen, seed)
        assert names(found) == {("base", "base")}, found.sentence

"""Stations of one check that contradict each other, by readings that MuJoCo makes."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from cells import NOISE_M, NOISE_RAD, Recorded, ur10

from modcal_core.calibration.store import Calibration
from modcal_core.errors import BadRecording
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_core.public import check

pytestmark = pytest.mark.slow
COUNT = 12


def postures(seed: int) -> Array:
    return np.random.default_rng([seed, 12]).uniform(-2.5, 2.5, (COUNT, 6))


def readings(q: Array, T: Array, seed: int, points: bool) -> Samples:
    """Poses (N, 4, 4) with the instrument's noise, or their points."""
    rng = np.random.default_rng([seed, 13])
    T = T.copy()
    T[:, :3, 3] += NOISE_M * rng.standard_normal((len(q), 3))
    T[:, :3, :3] = T[:, :3, :3] @ so3.exp(NOISE_RAD * rng.standard_normal((len(q), 3)))
    made = Samples.from_arrays(q, poses=T, names=ur10().names, stamps=1e6 + 5.0 * np.arange(len(q)))
    return replace(made, kind=np.full(len(q), "point")) if points else made


@pytest.mark.parametrize("points", [False, True])
@pytest.mark.parametrize("what", ["base", "tool"])
@pytest.mark.parametrize("after", [4, 7])
def test_what_moved_between_two_stations_is_refused(
    cell: tuple[Recorded, Calibration], what: str, points: bool, after: int
) -> None:
    recorded, calibration = cell
    move = se3.exp(np.array([4e-3, -3e-3, 2e-3, 1e-3, 2e-3, -1e-3]))
    for seed in range(2):
        q = postures(seed)
        T = recorded.world.tool_in_tracker(q)
        T[after:] = move @ T[after:] if what == "base" else T[after:] @ move
        with pytest.raises(BadRecording) as told:
            check(calibration, readings(q, T, seed, points))
        said = str(told.value)
        assert re.match(rf"the {what} .* moved between stations {after} and {after + 1} of this", said), said


@pytest.mark.parametrize("points", [False, True])
def test_readings_of_other_stations_are_refused(cell: tuple[Recorded, Calibration], points: bool) -> None:
    recorded, calibration = cell
    q = postures(5)
    T = recorded.world.tool_in_tracker(q)
    rows = np.arange(COUNT)
    rows[3:8] = [4, 5, 6, 7, 3]
    with pytest.raises(
        BadRecording, match=r"stations 4 to 8 belong to other stations.* \(that at station 4 to station 5\)"
    ):
        check(calibration, readings(q, T[rows], 5, points))


@pytest.mark.parametrize("points", [False, True])
def test_what_changed_before_all_stations_and_one_wrong_reading_are_no_contradiction(
    cell: tuple[Recorded, Calibration], points: bool
) -> None:
    recorded, calibration = cell
    move = se3.exp(np.array([4e-3, -3e-3, 2e-3, 1e-3, 2e-3, -1e-3]))
    for seed in range(2):
        q = postures(seed)
        T = recorded.world.tool_in_tracker(q)
        T = move @ T if seed else T @ move
        T[5, :3, 3] += (0.0, 0.02, 0.0)
        found = check(calibration, readings(q, T, seed, points))
        assert found.status == "changed", found.sentence
        assert {c.kind for c in found.changes} == {"base" if seed else "tool"}
        T = recorded.world.tool_in_tracker(q + 3e-3 * np.eye(6)[2])
        assert check(calibration, readings(q, move @ T, seed, points)).status != "unchanged"  # and is not refused


def test_a_base_that_moved_by_the_distance_of_neighbours_mixed_no_rows_up(cell: tuple[Recorded, Calibration]) -> None:
    """Readings of points then lie where the arm was at the station before; the move explains them all."""
    recorded, calibration = cell
    q = postures(2)[:1] + 0.02 * np.arange(COUNT)[:, None] * np.array([1.0, 0.3, -0.4, 0.5, 0.6, 0.2])
    T = recorded.world.tool_in_tracker(q)
    step = T[1, :3, 3] - T[0, :3, 3]
    moved = T.copy()
    moved[:, :3, 3] += step
    nearest = np.linalg.norm(moved[:, None, :3, 3] - T[None, :, :3, 3], axis=-1)
    assert (nearest.argmin(axis=1) != np.arange(COUNT)).sum() >= 8  # else nothing is shown
    assert check(calibration, readings(q, moved, 2, True)).status != "unchanged"


@pytest.mark.parametrize("count", [5, 8])
def test_readings_that_mean_nothing_are_refused_or_not_explained(
    cell: tuple[Recorded, Calibration], count: int
) -> None:
    recorded, calibration = cell
    for seed in range(2):
        q, rng = postures(seed), np.random.default_rng([seed, 14])
        T = recorded.world.tool_in_tracker(q)
        some = rng.choice(COUNT, count, replace=False)
        T[some] = se3.exp(np.c_[rng.uniform(-0.8, 0.8, (count, 3)), rng.uniform(-2.0, 2.0, (count, 3))])
        try:
            found = check(calibration, readings(q, T, seed, False))
        except BadRecording:
            continue
        assert found.status == "unexplained", found.sentence


def test_a_gear_of_any_course_is_no_contradiction(cell: tuple[Recorded, Calibration]) -> None:
    """A curve that no form was found for is none of the model's; base or tool of two parts have 12 or 6 numbers to
    please 30 readings of points with (seeds 10 and 11 were refused).
    """
    recorded, calibration = cell
    for seed in range(8, 12):
        q = postures(seed)[:10]
        joint = 4 if seed % 2 else 3
        turned = 2e-3 * np.sin((2.0 + seed) * q[:, joint] + seed)
        T = recorded.world.tool_in_tracker(q + turned[:, None] * np.eye(6)[joint])
        found = check(calibration, readings(q, T, seed, True))
        assert [(c.kind, c.place) for c in found.changes] == [("gear", ur10().names[joint])], found.sentence

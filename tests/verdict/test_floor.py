"""The floor: known from postures that were come back to, or stated; never from the scatter within a dwell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import ur10
from verdict.visits import NOISE_M, NOISE_RAD, tour, visited

from modcal_core.calibration.noise import Errors
from modcal_core.calibration.stated import Stated
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.verdict.floor import floors, reading_scatter_mm, returns_of


def noise(samples: Samples, rng: np.random.Generator, size: float = 1e-5) -> Errors:
    N = len(samples)
    return Errors(size * rng.standard_normal((N, 3)), size * rng.standard_normal((int(samples.is_pose.sum()), 3)))


def test_returns_are_found_and_nothing_else() -> None:
    samples = visited(1, 60, 7)
    _, q, back = tour(1, 60, 7)
    found = returns_of(samples)
    assert sorted(rows[1] for rows in found) == back
    assert all(np.array_equal(q[a], q[b]) for a, b in found)
    assert returns_of(visited(1, 60, 0)) == ()


def test_standing_still_is_no_return() -> None:
    samples = visited(1, 60, 0)
    twice = samples.select(np.repeat(np.arange(60), 3))
    assert returns_of(replace(twice, stamps=1.7e9 + np.arange(180.0), station=np.arange(180))) == ()


def test_the_same_side_is_no_return() -> None:
    """Where the approach is recorded it decides, and where it is not the station before does."""
    samples = visited(1, 60, 7)
    ones = np.ones_like(samples.q)
    assert returns_of(replace(samples, approach=ones)) == ()
    _, _, back = tour(1, 60, 7)
    other = ones.copy()
    other[back, 2] = -1.0
    assert len(returns_of(replace(samples, approach=other))) == 7


@pytest.mark.parametrize(("count", "known"), [(5, False), (6, True)])
def test_six_returns_make_a_floor(count: int, known: bool) -> None:
    samples = visited(2, 60, count)
    got = floors(noise(samples, np.random.default_rng(0)), samples, np.zeros(len(samples), bool), None)
    assert (got.position is not None) == known == (got.rotation is not None)
    assert got.returns == count


def test_a_rejected_visit_of_six_leaves_five_that_tell() -> None:
    """The arm was there and back; two rejected ones of six, or one of five, are too few."""
    for count, rejected, known in ((6, 1, True), (6, 2, False), (5, 1, False)):
        samples = visited(2, 60, count)
        wrong = np.zeros(len(samples), bool)
        wrong[[rows[1] for rows in returns_of(samples)[:rejected]]] = True
        got = floors(noise(samples, np.random.default_rng(0)), samples, wrong, None)
        assert (got.position is not None) == known == (got.rotation is not None)


@pytest.mark.slow
def test_the_interval_holds_what_was_planted() -> None:
    """200 draws of white noise, and of noise along one axis, which says a third as much."""
    samples = visited(3, 40, 8)
    rng = np.random.default_rng(5)
    held = {"white": 0, "line": 0}
    for _ in range(200):
        white = noise(samples, rng)
        line = replace(white, position=white.position * [1.0, 0.0, 0.0])
        for name, residuals, true in (("white", white, 3e-4), ("line", line, 1e-4)):
            floor = floors(residuals, samples, np.zeros(len(samples), bool), None).position
            held[name] += floor.interval[0] <= true <= floor.interval[1]
    assert held["white"] >= 0.9 * 200
    assert held["line"] >= 0.8 * 200


def test_one_wrong_reading_does_not_set_the_floor() -> None:
    samples = visited(3, 40, 12)
    rng = np.random.default_rng(5)
    residuals = noise(samples, rng)
    row = returns_of(samples)[4][1]
    residuals.position[row] += 3e-3
    floor = floors(residuals, samples, np.zeros(len(samples), bool), None).position
    assert floor.rms == pytest.approx(np.sqrt(3.0) * 1e-2, rel=0.5)
    assert floor.refused == pytest.approx(3.0 * np.sqrt(3.0) / np.sqrt(2.0), rel=0.05)


def test_returns_too_good_for_an_arm_show_no_floor_unless_the_instrument_is_stated() -> None:
    samples = visited(3, 40, 12)
    for size, known in ((2e-6, False), (1.5e-5, True)):
        residuals = noise(samples, np.random.default_rng(5), size)
        found = floors(residuals, samples, np.zeros(len(samples), bool), None, reach=1.3)
        assert (found.position is not None) == known
        assert bool(found.unknown) != known
        stated = Stated(instrument_mm=0.002)
        assert floors(residuals, samples, np.zeros(len(samples), bool), stated, reach=1.3).position is not None


@pytest.mark.slow
def test_repeatability_of_an_arm_in_mujoco() -> None:
    """Joints that miss by 40 µrad, seen through a whole calibration."""
    judged = calibrate(visited(4, 100, 12, joint_rad=4e-5), ur10(), np.random.default_rng(0), look_for_effects=False)
    floor_mm, floor_deg = judged.report.judged.floor_mm, judged.report.judged.floor_deg
    made, q, _ = tour(4, 100, 12)
    rng = np.random.default_rng(1)
    exact = made.world.tool_in_tracker(q)[:, :3, 3]
    square = [
        np.mean(np.sum((made.world.tool_in_tracker(q + 4e-5 * rng.standard_normal(q.shape))[:, :3, 3] - exact) ** 2, 1))
        for _ in range(5)
    ]
    planted_mm = 1e3 * np.sqrt(np.mean(square) + 3.0 * NOISE_M**2)
    # every axis turns the tool by its joint's error
    planted_deg = np.degrees(np.sqrt(6.0 * 4e-5**2 + 3.0 * NOISE_RAD**2))
    assert floor_mm == pytest.approx(planted_mm, rel=0.35)
    assert floor_deg == pytest.approx(planted_deg, rel=0.35)
    assert judged.report.judged.repeatability_mm.source == "revisits"
    assert judged.report.judged.status == "at_floor"


def test_a_stated_floor_needs_both_numbers() -> None:
    samples = visited(1, 40, 0)
    residuals, good = noise(samples, np.random.default_rng(0)), np.zeros(len(samples), bool)
    assert floors(residuals, samples, good, Stated(repeatability_mm=0.03)).position is None
    assert floors(residuals, samples, good, Stated(instrument_mm=0.03)).position is None
    both = floors(residuals, samples, good, Stated(repeatability_mm=0.03, instrument_mm=0.04)).position
    assert both.rms == pytest.approx(0.05)
    assert both.repeatability.source == "stated"
    assert both.instrument == pytest.approx(0.04**2)


@pytest.mark.slow
def test_iso_repeatability_by_drawing() -> None:
    """RP is the mean distance to the barycentre and three deviations of it: of a million visits with one deviation."""
    points = np.random.default_rng(0).normal(size=(1_000_000, 3))
    distance = np.linalg.norm(points - points.mean(axis=0), axis=1)
    rp = distance.mean() + 3.0 * distance.std()
    rms = Stated(repeatability_iso_mm=float(rp)).rms_mm
    assert rms == pytest.approx(np.sqrt(np.mean(distance**2)), rel=2e-3)


@pytest.mark.slow
def test_scatter_within_a_dwell_is_no_floor() -> None:
    samples = visited(1, 80, 0)
    samples = replace(samples, sigma_position=np.full(len(samples), NOISE_M))
    report = calibrate(samples, ur10(), np.random.default_rng(0), look_for_effects=False).report
    assert report.judged.floor_mm is None
    assert reading_scatter_mm(samples) == pytest.approx(1e3 * np.sqrt(3.0) * NOISE_M)
    assert report.judged.status == "cannot_tell"


def test_returns_that_jump_are_no_repeatability() -> None:
    samples = visited(3, 40, 8)
    good = np.zeros(len(samples), bool)
    residuals = noise(samples, np.random.default_rng(5))
    assert floors(residuals, samples, good, None).contradictions == ()
    for rows in returns_of(samples)[::2]:
        residuals.position[rows[1]] += [0.0, 5e-3, 0.0]
    (said,) = floors(residuals, samples, good, None).contradictions
    assert "4 agree" in said
    assert "jump" in said


def test_returns_that_differ_by_more_than_was_stated() -> None:
    samples = visited(3, 40, 8)
    residuals, good = noise(samples, np.random.default_rng(5)), np.zeros(len(samples), bool)
    assert floors(residuals, samples, good, Stated(repeatability_mm=0.02, instrument_mm=0.01)).contradictions == ()
    (said,) = floors(residuals, samples, good, Stated(repeatability_mm=0.004, instrument_mm=0.001)).contradictions
    assert "0.00412 mm was stated" in said

"""Readings that are no measurement, or contradict themselves, are named; those of an instrument are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import Recorded, record, samples_of, ur10
from verdict.visits import tour

from modcal_core.calibration.cell import Cell
from modcal_core.calibration.noise import Errors
from modcal_core.calibration.stated import Stated
from modcal_core.errors import BadRecording
from modcal_core.evaluation import evaluate
from modcal_core.geometry import so3
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.robots.kinematics import chain_forward
from modcal_core.verdict.computed import too_small
from modcal_core.verdict.contradicted import copied, cut_off
from modcal_core.verdict.tolerance import Asked, AtTool, assess
from modcal_core.verdict.verdict import Verdict

CHAIN = ur10()


def said(samples: Samples) -> str:
    report = calibrate(samples, CHAIN, np.random.default_rng(0), look_for_effects=False).report
    return " ".join(report.grounds.contradictions)


def coarse(left: Errors, samples: Samples) -> tuple[str, ...]:
    """What is said of the digits where the final model misses by so much, and the nominal one by an arm's error."""
    nominal = Errors(left.position + 2e-3, left.rotation)
    return too_small({"nominal": nominal, "final": left}, samples, samples, CHAIN, None).contradictions


def judgement(samples: Samples, cell: Cell | None = None) -> Verdict:
    report = calibrate(samples, CHAIN, np.random.default_rng(0), cell, look_for_effects=False).report
    assert report.judged is not None
    return report.judged


def by_joints(made: Recorded, rounded: float = 0.0) -> Samples:
    """What a controller publishes as the pose of its tool: forward kinematics of the joints, seen from its base."""
    T = chain_forward(CHAIN, made.samples.q)
    if rounded:
        T[:, :3, 3] = np.round(T[:, :3, 3] / rounded) * rounded
    return samples_of(CHAIN, made.samples.q, T)


@pytest.mark.slow
@pytest.mark.parametrize("rounded", [0.0, 1e-5])
def test_a_tcp_topic_is_no_measurement(rounded: float) -> None:
    assert "nominal model reproduces the readings" in said(by_joints(record(1, 100), rounded))


def test_whole_millimetres_that_a_good_arm_is_within_are_rounded_and_not_computed() -> None:
    made = record(1, 60, "point", length_std=2e-4, angle_std=2e-4)
    text = said(replace(made.samples, reading=np.round(made.samples.reading, 3)))
    assert "computed" not in text
    assert "rounded to 1 mm" in text


def test_goals_that_the_joints_missed_by_a_little_are_doubted() -> None:
    """Nothing is at a micrometre here: the joints miss what was asked for by 0.1 mrad, as drives do."""
    made = by_joints(record(4, 70))
    rng = np.random.default_rng(0)
    goals = replace(made, q=made.q + rng.normal(0.0, 1e-4, made.q.shape))
    judged = judgement(goals)
    assert judged.status == "cannot_tell"
    assert "before anything is calibrated" in judged.remedy
    assert assess(AtTool(0.1, (0.05, 0.2), "recorded ranges", 0.0, ""), Asked(1.0), judged).result == "CANNOT TELL"
    assert not judgement(goals, Cell(stated=Stated(repeatability_mm=0.1, instrument_mm=0.05))).unproven
    tracked = record(4, 70).samples
    assert not judgement(tracked).unproven
    good = calibrate(tracked, CHAIN, np.random.default_rng(0), look_for_effects=False).calibration
    frozen = evaluate(good, goals, np.random.default_rng(0), refit_base=True, refit_tool=True)
    assert "before anything is calibrated" in " ".join(frozen.grounds.unproven)


def test_returns_do_not_show_that_an_arm_as_drawn_was_measured() -> None:
    """Its readings scatter where they are repeated, and so do poses that a controller computes: only a person knows."""
    _, q, _ = tour(4, 80, 8)
    rng = np.random.default_rng(1)
    T = chain_forward(CHAIN, q + rng.normal(0.0, 1e-5, q.shape))
    T[:, :3, 3] += 5e-5 * rng.standard_normal((len(q), 3))
    T[:, :3, :3] = T[:, :3, :3] @ so3.exp(5e-5 * rng.standard_normal((len(q), 3)))
    judged = judgement(samples_of(CHAIN, q, T))
    assert judged.status == "cannot_tell"
    assert "before anything is calibrated" in judged.unproven
    judged = judgement(samples_of(CHAIN, q, T), Cell(stated=Stated(repeatability_mm=0.02, instrument_mm=0.087)))
    assert judged.status == "at_floor", judged.open_because


def test_rows_that_are_there_several_times_are_no_returns() -> None:
    samples = record(5, 40).samples
    assert copied(samples) == ()
    twice = samples.select(np.tile(np.arange(40), 2))
    twice = replace(twice, station=np.arange(80), stamps=np.arange(80.0))
    assert "80 of 80 stations are there several times" in copied(twice)[0]
    assert copied(replace(samples.select(np.repeat(np.arange(40), 2)), station=np.repeat(np.arange(40), 2))) == ()


@pytest.mark.parametrize("step", [0.0, 1e-4])
def test_computed_readings_are_named_at_any_number(step: float) -> None:
    for count in (8, 10, 15):
        made = record(3, count)
        samples = by_joints(made, step)
        every = dict.fromkeys(("nominal", "final"), Errors(np.full((3, 3), 1e-4), np.zeros((3, 3))))
        found = too_small(every, samples.select(slice(0, 3)), samples, CHAIN, None)
        assert any("reproduces the readings" in said for said in found.contradictions), (count, step)
        tracked = {"nominal": Errors(np.full((3, 3), 1e-3), np.zeros((3, 3))), "final": every["final"]}
        found = too_small(tracked, made.samples.select(slice(0, 3)), made.samples, CHAIN, None)
        assert not found.contradictions
        assert not found.unproven


@pytest.mark.slow
def test_another_controllers_own_calibration_and_a_noise_free_simulation_are_named() -> None:
    """Readings of a displaced arm to the last digit: the fitted model finds them again."""
    assert "fitted model reproduces the readings" in said(record(2, 100).exact)


@pytest.mark.slow
def test_readings_of_an_instrument_are_not_doubted() -> None:
    made = record(3, 100)
    assert said(made.samples) == ""
    rounded = replace(made.samples, reading=np.round(made.samples.reading, 4))
    assert said(rounded) == ""
    fine = record(3, 100, noise_m=5e-6, noise_rad=5e-6)
    assert said(fine.samples) == ""


@pytest.mark.slow
def test_a_target_that_turned_is_named_in_evaluate_too() -> None:
    made = record(4, 100)
    rng = np.random.default_rng(1)
    turned = replace(made.samples, R=made.samples.R @ so3.exp(0.1 * rng.normal(size=(100, 3))))
    assert "Orientations miss by" in said(turned)
    good = calibrate(made.samples, CHAIN, np.random.default_rng(0), look_for_effects=False).calibration
    assert evaluate(good, made.exact, rng).grounds.contradictions == ()
    assert "Orientations miss" in " ".join(evaluate(good, turned, rng).grounds.contradictions)


@pytest.mark.slow
def test_topics_that_repeat_themselves_are_named() -> None:
    made = record(5, 100)
    position, R, q = made.samples.reading.copy(), made.samples.R.copy(), made.samples.q.copy()
    position[40:45], R[40:45] = position[40], R[40]
    assert "readings stand still over 5 stations" in said(replace(made.samples, reading=position, R=R))
    q[40:44] = q[40]
    assert "joint positions stand still over 4 stations" in said(replace(made.samples, q=q))


@pytest.mark.slow
def test_readings_computed_before_the_joints_were_rounded() -> None:
    exact = record(5, 100).exact
    step = np.radians(1e-3)
    assert "before these were rounded" in said(replace(exact, q=step * np.round(exact.q / step)))
    measured = record(5, 100, noise_m=2e-5, noise_rad=2e-5).samples
    assert said(replace(measured, q=step * np.round(measured.q / step))) == ""


@pytest.mark.slow
def test_positions_rounded_to_the_size_of_the_error() -> None:
    made = record(6, 100)
    assert "Positions are rounded to 1 mm" in said(replace(made.samples, reading=np.round(made.samples.reading, 3)))


@pytest.mark.slow
def test_joints_rounded_to_the_size_of_the_error() -> None:
    """MuJoCo's readings are of where the arm stood; all joints, or one, are written with too few digits."""
    samples = record(6, 100).samples
    assert "Joint positions are rounded to 0.001 rad" in said(replace(samples, q=np.round(samples.q, 3)))
    q = samples.q.copy()
    q[:, 1] = np.round(q[:, 1], 3)
    assert "The positions of shoulder_lift_joint are rounded" in said(replace(samples, q=q))
    q[:, 1] = np.round(samples.q[:, 1], 5)
    assert said(replace(samples, q=q)) == ""


def test_the_zeros_of_a_socket_are_not_rounded() -> None:
    samples = record(6, 40, "point").samples
    zero = replace(samples, reading=np.zeros((40, 3)), sockets=("tracker",))
    left = Errors(np.full((40, 3), 1e-4), np.empty((0, 3)))
    assert coarse(left, zero) == ()
    rounded = replace(samples, reading=np.round(samples.reading, 3))
    assert coarse(Errors(np.full((40, 3), 3e-4), np.empty((0, 3))), rounded) != ()
    assert coarse(Errors(np.full((40, 3), 3e-3), np.empty((0, 3))), rounded) == ()


@pytest.mark.slow
def test_readings_in_a_plane() -> None:
    made = record(7, 60)
    with pytest.raises(BadRecording, match="coordinate z of the readings"):
        said(replace(made.samples, reading=made.samples.reading * [1.0, 1.0, 0.0]))


def test_a_coordinate_that_is_cut_off() -> None:
    """As a depth camera writes its greatest distance for all that is farther; noise alone repeats nothing."""
    samples = record(5, 80).samples
    assert cut_off(samples) == ()
    position = samples.reading.copy()
    position[:, 2] = np.minimum(position[:, 2], np.quantile(position[:, 2], 0.8))
    (sentence,) = cut_off(replace(samples, reading=position))
    assert "coordinate z of the readings is exactly" in sentence
    assert "at 16 of 80 stations, its largest value" in sentence
    position = samples.reading.copy()
    position[::10] = 0.0
    (sentence,) = cut_off(replace(samples, reading=position))
    assert "positions are exactly (0, 0, 0) m at 8 of 80 stations" in sentence
    assert cut_off(replace(samples, reading=np.round(samples.reading, 2))) == ()  # rounded columns repeat themselves


def test_digits_that_are_no_decimals() -> None:
    samples = record(6, 60).samples
    written = replace(samples, reading=np.round(samples.reading / 0.000254) * 0.000254)
    missed = written.reading - samples.reading
    left = Errors(missed, np.zeros((60, 3)))
    (sentence,) = coarse(left, written)
    assert "rounded to 0.254 mm" in sentence
    assert coarse(Errors(20.0 * missed, np.zeros((60, 3))), written) == ()

"""The status: which of three words, and why."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import ur10
from verdict.visits import visited

from modcal_core.calibration.cell import Cell
from modcal_core.calibration.data_split import RejectedPlace
from modcal_core.calibration.stated import Stated
from modcal_core.geometry import so3
from modcal_core.loop import Solution, calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.verdict.case import Case, fitted_case
from modcal_core.verdict.grounds import Grounds, NotApplied
from modcal_core.verdict.status import CHECKS, judge
from modcal_core.verdict.verdict import Verdict


def verdict_of(samples: Samples, stated: Stated | None = None) -> Verdict:
    cell = Cell(stated=stated) if stated else Cell()
    return calibrate(samples, ur10(), np.random.default_rng(0), cell, look_for_effects=False).report.judged


def case_of(result: Solution, samples: Samples) -> Case:
    report = result.report
    return fitted_case(result.scored, samples, report.sets, report.wrong, report.errors)


def test_a_check_waits_only_for_checks_before_it() -> None:
    before = []
    for check in CHECKS:
        assert set(check.unless) <= set(before)
        before.append(check.look)
    assert len(set(before)) == len(before)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", ["pose", "point"])
def test_good_arms(seed: int, kind: str) -> None:
    """At the floor where postures were come back to, else it cannot be told; never open."""
    assert verdict_of(visited(20 + seed, 80, 8, kind, joint_rad=2e-5)).status == "at_floor"
    without = verdict_of(visited(20 + seed, 80, 0, kind, joint_rad=2e-5))
    assert without.status == "cannot_tell"
    assert "visit 6 of these postures twice" in without.remedy
    assert "state" in without.remedy


@pytest.mark.slow
def test_a_stated_position_alone_says_nothing_of_orientation() -> None:
    judged = verdict_of(visited(3, 80, 0), Stated(repeatability_mm=0.03, instrument_mm=0.02))
    assert judged.status == "cannot_tell"
    assert judged.floor_mm is not None
    assert judged.floor_deg is None
    assert "degrees" in judged.remedy
    assert (
        verdict_of(visited(3, 80, 0, "point"), Stated(repeatability_mm=0.03, instrument_mm=0.02)).status == "at_floor"
    )


def test_a_floor_that_the_parameters_hide_is_not_called_reached() -> None:
    """At the floor as it is; not where the parameters' uncertainty makes more than arm and instrument do."""
    samples = visited(20, 80, 8, "point", joint_rad=2e-5)
    result = calibrate(samples, ur10(), np.random.default_rng(0), look_for_effects=False)
    case = case_of(result, samples)
    assert judge(case).status == "at_floor"
    wide = replace(case.known, covariance=100.0 * case.known.covariance)
    vague = judge(replace(case, known=wide, again=lambda noise: wide))
    assert vague.status == "cannot_tell"
    assert vague.floor_known
    assert "record more different postures" in vague.remedy


@pytest.mark.slow
def test_more_than_was_stated_is_open() -> None:
    stated = Stated(repeatability_mm=0.01, instrument_mm=0.01, repeatability_deg=0.01, instrument_deg=0.01)
    judged = verdict_of(visited(3, 80, 0), stated)
    assert judged.status == "open"
    assert [r.kind for r in judged.reasons] == ["above_floor"]
    assert "was stated" in judged.open_because[0]


@pytest.mark.slow
def test_a_stated_floor_far_above_what_is_left_is_contradicted() -> None:
    """Micrometres stated as millimetres: no model predicts what an arm does not repeat."""
    samples = visited(3, 80, 0, "point")
    judged = verdict_of(samples, Stated(repeatability_mm=30.0, instrument_mm=20.0))
    assert judged.status == "open"
    assert "the statement cannot be true" in judged.open_because[0]
    twice = Stated(repeatability_mm=0.06, instrument_mm=0.06)  # cautious, as data sheets are
    assert verdict_of(samples, twice).status == "at_floor"


@pytest.mark.slow
def test_orientations_that_drift_alone_are_open() -> None:
    samples = visited(5, 100, 8)
    angle = np.outer(np.linspace(0.0, 6e-3, len(samples)), [0.0, 0.0, 1.0])
    judged = verdict_of(replace(samples, R=so3.exp(angle) @ samples.R))
    assert judged.status == "open"
    assert any("the order of the stations" in said for said in judged.open_because)


@pytest.mark.slow
def test_readings_of_a_mixed_up_orientation_are_never_calm() -> None:
    """Every third quaternion conjugated: large orientation residuals on a sound position."""
    samples = visited(7, 100, 8)
    R = samples.R.copy()
    R[::3] = np.swapaxes(R[::3], 1, 2)
    judged = verdict_of(replace(samples, R=R))
    assert judged.status == "open"


@pytest.mark.slow
def test_every_ground_is_named() -> None:
    samples = visited(3, 80, 8)
    result = calibrate(samples, ur10(), np.random.default_rng(0), look_for_effects=False)
    case = case_of(result, samples)
    assert judge(case).status == "at_floor"
    square = float(np.mean((1e3 * case.errors["final"].position_norm) ** 2))
    grounds = {
        "not_converged": Grounds(converged=False),
        "not_applied": Grounds(not_applied=(NotApplied("elbow axis by load", "no effort", 0.11 * square),)),
        "contradiction": Grounds(contradictions=("Two known distances disagree.",)),
        "rejected": Grounds(rejected_runs=((3, 9),)),
    }
    place = Grounds(rejected_places=(RejectedPlace("elbow_joint", 1.0, 1.2, 5),))
    for kind, ground in (*grounds.items(), ("rejected", place)):
        judged = judge(case, ground)
        assert judged.status == "open"
        assert [r.kind for r in judged.reasons] == [kind]
    cheap = Grounds(not_applied=(NotApplied("elbow axis by load", "no effort", 0.09 * square),))
    assert judge(case, cheap).status == "at_floor"
    wrong = case.wrong.copy()
    wrong[case.held_out[:3]] = True
    assert judge(replace(case, wrong=wrong)).status == "at_floor"
    wrong[case.held_out[:9]] = True
    assert judge(replace(case, wrong=wrong)).status == "open"


@pytest.mark.slow
def test_an_arm_that_does_not_repeat_is_questioned_unless_it_was_stated() -> None:
    samples = visited(1, 80, 8, noise_m=8e-4, noise_rad=1e-3)
    loose, stated = verdict_of(samples), verdict_of(samples, Stated(repeatability_mm=1.4))
    assert loose.status == "open"
    assert any("were visited again differ by" in said for said in loose.open_because)
    assert not any("were visited again differ by" in said for said in stated.open_because)

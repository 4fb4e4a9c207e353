"""The status: which of three words, and why; both tails of what is left, and floors of exchangeable returns alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, ur10
from verdict.visits import visited

from modcal_core.calibration.cell import Cell
from modcal_core.calibration.covariance import rejected
from modcal_core.calibration.data_split import RejectedPlace
from modcal_core.calibration.noise import Errors
from modcal_core.calibration.stated import Stated
from modcal_core.geometry import so3
from modcal_core.loop import Solution, calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.report.report import to_json_data
from modcal_core.verdict.case import Case, fitted_case
from modcal_core.verdict.floor import Floor, depends_on, floors, returns_of
from modcal_core.verdict.grounds import Grounds, NotApplied, too_many
from modcal_core.verdict.status import CHECKS, MAX_ABOVE_FLOOR, judge
from modcal_core.verdict.tails import Tail
from modcal_core.verdict.verdict import Repeatability, Verdict


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


CHAIN = ur10()


def floor_of(square: float, freedom: float = 0.0) -> Floor:
    return Floor(square, Repeatability(None, "stated"), 0.0, freedom=freedom)


@pytest.mark.parametrize(("count", "freedom"), [(3, 0.0), (5, 12.0), (50, 0.0), (5000, 12.0)])
def test_noise_as_large_as_the_floor_is_in_neither_tail(count: int, freedom: float) -> None:
    """Mean squares of what is expected, drawn 500 times, and of floors that are known to a factor."""
    rng = np.random.default_rng(count)
    degrees = 2.0 * count
    found = {"above": 0, "below": 0, "large": 0, "small": 0}
    for _ in range(500):
        square = float(rng.chisquare(degrees)) / degrees
        floor = floor_of(float(rng.chisquare(freedom)) / freedom if freedom else 1.0, freedom)
        tail = Tail(square, 0.0, floor, degrees, count)
        found["above"] += tail.above(1.0)
        found["below"] += tail.below(1.0)
        found["large"] += replace(tail, square=100.0 * square).above(MAX_ABOVE_FLOOR)
        found["small"] += replace(tail, square=1e-4 * square).below(4.0)
    assert found["above"] <= 25
    assert found["below"] <= 25
    if count >= 15 or (count >= 5 and not freedom):
        assert min(found["large"], found["small"]) == 500


def test_half_of_the_stations_off_do_not_excuse_themselves() -> None:
    """The covariance comes from the floor: parameters of such a misfit are not as uncertain as it is large."""
    made = record(8, 40)
    off = made.samples.reading + np.where(np.arange(40)[:, None] % 2, [0.01, 0.0, 0.0], 0.0)
    said = Stated(repeatability_mm=0.03, instrument_mm=0.04, repeatability_deg=0.01, instrument_deg=0.01)
    samples = replace(made.samples, reading=off)
    found = calibrate(samples, CHAIN, np.random.default_rng(0), Cell(stated=said), look_for_effects=False)
    assert found.report.status == "open"
    case = case_of(found, samples)
    wide, narrow = np.trace(case.known.covariance), np.trace(case.with_floor(0.05, 0.014).known.covariance)
    assert narrow < 0.1 * wide
    assert case.with_floor(None, None) is case


@pytest.mark.parametrize("fault", ["drift", "late", "order", ""])
def test_returns_that_are_not_exchangeable_show_no_floor(fault: str) -> None:
    samples = visited(3, 60, 14)
    rng = np.random.default_rng(1)
    x = 2e-5 * rng.standard_normal((len(samples), 3))
    time = (samples.stamps - samples.stamps[0]) / np.ptp(samples.stamps)
    visits = returns_of(samples)
    if fault == "drift":
        x += 2e-4 * time[:, None] * [1.0, 0.0, 0.0]
    if fault == "late":
        x *= 1.0 + 60.0 * np.clip(time[:, None] - 0.55, 0.0, 1.0)
    if fault == "order":
        x[[rows[1] for rows in visits]] += [0.0, 1e-4, 0.0]
    found = depends_on(x, visits, samples)
    times = ("the time between them", "when they were made", "their order")  # which go together in this tour
    assert found in (times if fault else ("",))
    known = floors(Errors(x, np.zeros((len(x), 3))), samples, np.zeros(len(x), bool), None, CHAIN.reach())
    assert (known.position is None) == bool(fault)
    assert (known.unknown != "") == bool(fault)


def test_returns_are_exchangeable_by_chance_as_often_as_is_stated() -> None:
    samples = visited(3, 60, 14)
    rng = np.random.default_rng(2)
    visits = returns_of(samples)
    count = sum(depends_on(rng.standard_normal((len(samples), 3)), visits, samples) != "" for _ in range(200))
    assert count <= 7


def test_returns_that_differ_by_more_than_arms_do_show_a_floor_only_where_it_was_stated() -> None:
    samples = visited(4, 60, 8)
    x = 3e-4 * np.random.default_rng(0).standard_normal((len(samples), 3))
    left, none = Errors(x, np.zeros((len(x), 3))), np.zeros(len(x), bool)
    assert floors(left, samples, none, None, CHAIN.reach()).position is None
    assert floors(left, samples, none, Stated(instrument_mm=0.5), CHAIN.reach()).position is not None
    assert floors(left, samples, none, Stated(repeatability_mm=0.5), CHAIN.reach()).position is not None


def test_single_wrong_readings_are_few_at_any_number() -> None:
    def many(count: int, of: int) -> bool:
        samples = Samples.from_arrays(np.zeros((of, 6)), points=np.zeros((of, 3)))
        return too_many(np.arange(of) < count, samples)

    assert not many(0, 15)
    assert not many(1, 15)
    assert many(3, 15)
    assert not many(10, 160)
    assert many(11, 160)


@pytest.mark.parametrize("seed", range(2))
def test_few_stations_reject_none_that_are_right(seed: int) -> None:
    samples = record(40 + seed, 16).samples
    found = calibrate(samples, CHAIN, np.random.default_rng(0), look_for_effects=False)
    assert found.report.wrong.sum() <= 1
    assert found.report.status != "open"
    asked = {question["what"]: question["needs"] for question in to_json_data(found.report)["not_asked"]}
    assert any("scatters more than the others" in what for what in asked)
    assert any("too few to ask" in note for note in found.report.notes)
    far = samples.reading.copy()
    far[found.report.sets.held_out[0]] += 0.05
    wrong = rejected(found.scored, replace(samples, reading=far), found.report.sets.train)
    assert wrong[found.report.sets.held_out[0]]

"""Both tails of what is left, at any number of stations; floors of exchangeable returns alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, ur10
from verdict.test_status import case_of
from verdict.visits import visited

from modcal_core.calibration.cell import Cell
from modcal_core.calibration.covariance import rejected
from modcal_core.calibration.noise import Errors
from modcal_core.calibration.stated import Stated
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.report.as_json import to_json_data
from modcal_core.verdict.floor import Floor, depends_on, floors, returns_of
from modcal_core.verdict.rejected import too_many
from modcal_core.verdict.status import MAX_ABOVE_FLOOR
from modcal_core.verdict.tails import Tail
from modcal_core.verdict.verdict import Repeatability

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

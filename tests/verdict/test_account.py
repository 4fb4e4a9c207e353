"""The account sums, its rows mean what they say, and an effect costs what it gained; columns that are never written out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import noisy, ur10
from verdict.visits import tour, visited

from modcal_core.calibration.cell import Cell
from modcal_core.calibration.covariance import without
from modcal_core.calibration.noise import errors
from modcal_core.calibration.stated import Stated
from modcal_core.loop import Solution, calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.verdict.account import DRAWS, contributions_of, left_without, resampled
from modcal_core.verdict.case import fitted_case

pytestmark = pytest.mark.slow


def geared(seed: int = 5, stations: int = 120) -> Samples:
    """Two joints with gear errors of 0.3 and 0.15 mm."""
    made, q, _ = tour(seed, stations, 8)
    rng = np.random.default_rng(seed)
    sent = q.copy()
    sent[:, 2] += 5e-4 * np.sin(17.0 * q[:, 2] + 0.3)
    sent[:, 1] += 2e-4 * np.sin(23.0 * q[:, 1])
    T = made.world.tool_in_tracker(sent)
    T = noisy(T, 2e-5, 3e-5, rng)
    return replace(visited(seed, stations, 8), reading=T[:, :3, 3], R=T[:, :3, :3])


@pytest.fixture(scope="module")
def found() -> tuple[Samples, Solution]:
    samples = geared()
    return samples, calibrate(samples, ur10(), np.random.default_rng(0))


def test_rows_sum_to_the_nominal_square(found: tuple[Samples, Solution]) -> None:
    report = found[1].report
    for account, norm in (
        (report.judged.account_mm2, 1e3 * report.errors["nominal"].position_norm),
        (report.judged.account_deg2, np.degrees(report.errors["nominal"].rotation_norm)),
    ):
        assert account is not None
        square = float(np.mean(norm**2))
        assert sum(row.value for row in account) == pytest.approx(square, rel=1e-9)
        names = [row.what for row in account]
        assert names[0] == "geometry"
        order = ["shared", "predictable", "estimation", "repeatability", "instrument", "unaccounted"]
        assert [n for n in names[1:] if not n.startswith("effect:")] == order


def test_removal_costs_what_a_fit_without_the_effect_costs(found: tuple[Samples, Solution]) -> None:
    """The cheap refit against a whole one."""
    from modcal_core.calibration.fit import identify

    samples, result = found
    report, fit = result.report, result.scored
    assert {f.family for f in report.effects} == {"gear_harmonic"}
    case = fitted_case(fit, samples, report.sets, report.wrong, report.errors)
    parts = contributions_of(case)
    assert sorted(i for part in parts for i in part.numbers) == list(range(len(fit.model.effects)))
    train = samples.select(report.sets.train)
    with_all = np.mean(report.errors["final"].position_norm ** 2)
    for part in parts:
        effects = fit.model.effects
        start = fit.start.with_effects([e for i, e in enumerate(effects) if i not in part.numbers])
        again = identify(start, train, fit.parameters, begin=fit.values, robust=False)
        cost = 1e6 * (np.mean(errors(again.model, report.scored).position_norm ** 2) - with_all)
        assert part.mm2 == pytest.approx(cost, rel=0.1, abs=1e-5)
        assert part.ci95_mm2[0] > 0.0
        assert part.ci95_mm2[0] < part.mm2 < part.ci95_mm2[1]


def test_a_model_without_an_effect_is_never_worse_than_geometry_alone(found: tuple[Samples, Solution]) -> None:
    """Values so large that one step of the others ends far outside where it holds."""
    samples, result = found
    report, model = result.report, result.scored.model
    wild = model.with_effects([replace(e, values=3e3 * e.values) for e in model.effects])
    case = replace(fitted_case(result.scored, samples, report.sets, report.wrong, report.errors), model=wild)
    alone = report.errors["geometric"]
    assert errors(without(wild, case.known, (0,)), report.scored).position_norm.mean() > alone.position_norm.mean()
    left = left_without(case, (0,))
    np.testing.assert_array_equal(left.position, alone.position)
    np.testing.assert_array_equal(left.rotation, alone.rotation)


def test_what_is_left_is_what_does_not_repeat(found: tuple[Samples, Solution]) -> None:
    judged = found[1].report.judged
    rows = {row.what: row.value for row in judged.account_mm2}
    noise = 3.0 * (1e3 * 2e-5) ** 2
    assert rows["repeatability"] == pytest.approx(noise, rel=0.9)
    assert abs(rows["predictable"]) < 0.3 * noise
    assert judged.status == "at_floor", judged.open_because


def test_estimation_is_what_the_parameters_cost() -> None:
    """Arms of the same errors, with other noise: the variance of their fits at the postures held out."""
    made, q, _ = tour(9, 60, 0)
    rng = np.random.default_rng(2)
    probe = rng.uniform(-np.pi, np.pi, (60, 6))
    exact = made.world.tool_in_tracker(probe)[:, :3, 3]
    squares, said = [], []
    for _ in range(6):
        T = made.world.tool_in_tracker(q)
        T = noisy(T, 5e-5, 5e-5, rng)
        samples = replace(made.samples, reading=T[:, :3, 3], R=T[:, :3, :3])
        result = calibrate(samples, ur10(), rng, look_for_effects=False)
        gap = result.scored.model.predict(probe)[:, :3, 3] - exact
        squares.append(1e6 * np.mean(np.sum(gap**2, axis=1)))
        said.append(next(r.value for r in result.report.judged.account_mm2 if r.what == "estimation"))
    assert np.mean(said) == pytest.approx(np.mean(squares), rel=0.3)


def test_a_stated_floor_stands_in_the_account() -> None:
    stated = Stated(repeatability_mm=0.03, instrument_mm=0.02, repeatability_deg=0.002, instrument_deg=0.002)
    judged = calibrate(
        visited(3, 80, 0), ur10(), np.random.default_rng(0), Cell(stated=stated), look_for_effects=False
    ).report.judged
    rows = {row.what: row.value for row in judged.account_mm2}
    assert rows["repeatability"] == pytest.approx(9e-4)
    assert rows["instrument"] == pytest.approx(4e-4)
    assert judged.status == "at_floor"
    turned = {row.what: row.value for row in judged.account_deg2}
    assert turned["instrument"] == pytest.approx(4e-6)


def test_intervals_are_those_of_stations_that_are_drawn_again() -> None:
    rng = np.random.default_rng(4)
    station = np.sort(rng.integers(40, size=150))
    square = rng.chisquare(3.0, 150)
    mean, (low, high) = resampled(square, station)
    stations = np.unique(station)
    draws = np.random.default_rng(0).integers(len(stations), size=(DRAWS, len(stations)))
    means = [np.mean(np.concatenate([square[station == stations[k]] for k in draw])) for draw in draws]
    assert np.allclose([mean, low, high], [square.mean(), *np.percentile(means, [2.5, 97.5])], rtol=1e-12)

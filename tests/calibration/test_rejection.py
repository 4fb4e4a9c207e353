"""Nothing is dropped in silence: rejections are counted, runs are seen, and stations that a curve missed are taken in again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import Recorded, record, samples_of, ur10

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.data_split import chance_of_run, places_of, runs_of
from modcal_core.calibration.final_fit import finalise, uncontradicted
from modcal_core.calibration.store import from_data, to_data
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.effects.effect import Effect
from modcal_core.effects.shapes import Shape
from modcal_core.evaluation import evaluate
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.report.report import to_json_data
from modcal_core.report.tables import sentence

COUNT = 160


def shifted(samples: Samples, rows: np.ndarray, by: float = 0.005) -> Samples:
    position = samples.reading.copy()
    position[rows, 0] += by
    return replace(samples, reading=position)


@pytest.fixture(scope="module")
def made() -> Recorded:
    return record(4, 2 * COUNT, "pose")


@pytest.mark.slow
def test_a_frozen_model_is_judged_by_its_own_spread(made: Recorded) -> None:
    """45 % of the stations shifted by 5 mm: the scored data must not set their own limit."""
    first, second = made.samples.select(slice(None, COUNT)), made.samples.select(slice(COUNT, None))
    frozen = calibrate(first, ur10(), np.random.default_rng(0), look_for_effects=False).calibration
    frozen = from_data(to_data(frozen))
    bad = np.random.default_rng(1).random(COUNT) < 0.45
    report = evaluate(frozen, shifted(second, bad), np.random.default_rng(0))
    size = report.size_mm("final")
    assert size.rms == pytest.approx(5.0 * np.sqrt(bad.mean()), rel=0.05)
    assert (report.rejection.stations, report.rejection.of) == (int(bad.sum()), COUNT)
    assert report.rejection.with_mm == pytest.approx(size.rms)
    assert report.rejection.without_mm is not None
    assert report.rejection.without_mm < 0.2
    # single wrong readings are still left out
    few = evaluate(frozen, shifted(second, np.arange(COUNT) % 40 == 3), np.random.default_rng(0))
    assert few.size_mm("final").rms < 0.2
    assert few.rejected == 4
    assert few.rejection.with_mm is not None
    assert few.rejection.with_mm > 0.5
    # and a clean recording has none
    clean = evaluate(frozen, second, np.random.default_rng(0))
    assert clean.rejection.stations == 0


@pytest.mark.slow
def test_without_a_stated_deviation_the_usual_one_is_taken(made: Recorded) -> None:
    """Spread is what readings do not scatter by themselves: that must not be missing where a recording is silent."""
    stated = replace(made.samples, sigma_position=np.full(2 * COUNT, 5e-5), sigma_rotation=np.full(2 * COUNT, 5e-5))
    frozen = calibrate(stated.select(slice(None, COUNT)), ur10(), np.random.default_rng(0), look_for_effects=False)
    assert frozen.calibration.noise.position < 4e-5
    report = evaluate(frozen.calibration, made.samples.select(slice(COUNT, None)), np.random.default_rng(0))
    assert report.rejected == 0


@pytest.mark.slow
def test_both_errors_of_a_calibration(made: Recorded) -> None:
    """10 % shifted: the fit leaves them out, and says what the error is with them."""
    bad = np.random.default_rng(1).random(COUNT) < 0.1
    samples = shifted(made.samples.select(slice(None, COUNT)), bad)
    result = calibrate(samples, ur10(), np.random.default_rng(0), look_for_effects=False)
    rejection = result.report.rejection
    assert rejection.stations == bad.sum()
    assert rejection.share == pytest.approx(bad.mean())
    assert rejection.with_mm == pytest.approx(5.0 * np.sqrt(bad[result.report.sets.held_out].mean()), rel=0.1)
    assert rejection.without_mm is not None
    assert rejection.without_mm < 0.2
    np.testing.assert_array_equal(result.report.wrong, bad)


@pytest.mark.slow
def test_the_shipped_model_rejects_what_the_scored_one_does(made: Recorded) -> None:
    """Readings just inside the limit count in both; shipped with its own judgement they would not."""
    samples = shifted(made.samples.select(slice(None, COUNT)), np.arange(COUNT) % 8 == 0)
    result = calibrate(samples, ur10(), np.random.default_rng(0), look_for_effects=False)
    wrong = result.report.wrong
    assert wrong.sum() == 20
    choice = choose_parameters(result.scored.start, views_of(samples))
    alone = finalise(samples.select(~wrong), ur10(), choice, Cell(), None, result.scored, np.zeros(COUNT - 20, bool))
    np.testing.assert_allclose(alone.calibrated.T_tip_tool, result.calibration.calibrated.T_tip_tool, atol=1e-9)


def test_runs_are_told_from_scattered_rejections(made: Recorded) -> None:
    samples = made.samples.select(slice(None, COUNT))
    run = np.isin(np.arange(COUNT), [40, 41, 42, 43])
    assert runs_of(samples, run) == ((40, 43),)
    # in order of time, however the rows stand
    shuffled = np.random.default_rng(0).permutation(COUNT)
    assert runs_of(samples.select(shuffled), run[shuffled]) == ((40, 43),)
    assert runs_of(samples, np.isin(np.arange(COUNT), [3, 4, 30, 70, 71, 120])) == ()
    # three in a row are nothing among forty
    many = np.zeros(COUNT, bool)
    many[np.r_[0:120:3, 50, 51]] = True
    assert runs_of(samples, many) == ()


def test_rejections_at_one_place_are_told_from_scattered_ones(made: Recorded) -> None:
    """Neighbours by a joint's position, measured at quite different times."""
    samples = made.samples.select(slice(None, COUNT))
    order = np.argsort(samples.q[:, 2])
    there = np.isin(np.arange(COUNT), order[-6:])
    (place,) = places_of(samples, there)
    assert (place.joint, place.stations) == (samples.names[2], 6)
    assert (place.low, place.high) == (samples.q[order[-6], 2], samples.q[order[-1], 2])
    shuffled = np.random.default_rng(0).permutation(COUNT)
    assert places_of(samples.select(shuffled), there[shuffled]) == (place,)
    # others that are wrong elsewhere hide it only where they are many
    few = there | np.isin(np.arange(COUNT), order[[3, 50, 51, 90]])
    assert [p.joint for p in places_of(samples, few)] == [samples.names[2]]
    assert places_of(samples, np.isin(np.arange(COUNT), order[-2:])) == ()
    rng = np.random.default_rng(5)
    said = 0
    for _ in range(400):
        scattered = np.isin(np.arange(COUNT), rng.choice(COUNT, int(rng.integers(3, 9)), replace=False))
        said += bool(places_of(samples, scattered))
    assert said <= 4  # 1 %


@pytest.mark.slow
def test_what_errs_at_one_sparse_place_alone_is_said() -> None:
    """A gear that errs where 6 of 206 stations stand, at different times: all six are rejected, and that is no chance."""
    made, rng = record(3, 10), np.random.default_rng(3)
    q = rng.uniform(-1.2, 1.2, (206, 6))
    q[:, 2] = rng.permutation(np.r_[rng.uniform(-0.6, 0.6, 200), rng.uniform(1.0, 1.25, 6)])
    turned = q.copy()
    turned[:, 2] += np.where(q[:, 2] > 0.9, 2e-3 * np.sin(20.0 * q[:, 2]), 0.0)
    T = made.world.tool_in_tracker(turned)
    T[:, :3, 3] += 2e-5 * rng.standard_normal((len(q), 3))
    report = calibrate(samples_of(ur10(), q, T), ur10(), np.random.default_rng(0)).report
    assert report.wrong.sum() >= 5
    assert report.judged.status == "open"
    assert any("elbow_joint between 1" in said for said in report.judged.open_because)


def test_chance_of_a_run_by_simulation() -> None:
    rng = np.random.default_rng(0)
    hits, trials = 0, 4000
    for _ in range(trials):
        flags = np.zeros(COUNT, int)
        flags[rng.choice(COUNT, 20, replace=False)] = 1
        hits += np.convolve(flags, np.ones(3, int), "valid").max() == 3
    bound = chance_of_run(3, 20, COUNT)
    assert hits / trials <= bound <= 1.5 * hits / trials


ELBOW = 2


def postures(rng: np.random.Generator, dense: int, sparse: int) -> Array:
    """Many postures with the elbow within 0.6 rad, and a few beyond, which the arm comes through three times."""
    q = rng.uniform(-1.2, 1.2, (dense + sparse, 6))
    q[:, ELBOW] = np.r_[rng.uniform(-0.6, 0.6, dense), rng.uniform(1.0, 1.25, sparse)]
    near, far = np.split(np.arange(len(q)), [dense])
    parts = zip(np.array_split(near, 3), np.array_split(far, 3), strict=True)
    return q[np.concatenate([np.r_[a, b] for a, b in parts])]


def test_a_rejected_station_counts_as_wrong_where_others_speak() -> None:
    rng = np.random.default_rng(1)
    made = record(3, 10)
    q = postures(rng, 200, 6)
    samples = samples_of(ur10(), q, made.world.tool_in_tracker(q))
    shape = Shape("spline", {"low": -0.6, "high": 1.25, "count": 40.0})
    curve = Effect("gear_harmonic", "elbow_joint", "axis", "position:elbow_joint", shape, np.zeros(40), np.zeros(40))
    model = fit_cell(ur10(), samples, Cell()).model.with_effects((curve,))
    far = q[:, ELBOW] > 1.0
    among = np.zeros(len(q), bool)
    among[np.flatnonzero(~far)[:5]] = True
    assert uncontradicted(model, samples, far).sum() >= 3
    assert not uncontradicted(model, samples, among).any()
    one = np.zeros(len(q), bool)
    one[np.flatnonzero(far)[0]] = True
    assert not uncontradicted(model, samples, one).any()  # the others of the place contradict it
    assert not uncontradicted(model.with_effects(()), samples, far).any()
    assert not (uncontradicted(model, samples, far | among) & ~far).any()


class Bent:
    """A gear that errs by a whole curve, by 0.9 mrad RMS where few stations stand: six times what it does elsewhere."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(3)
        self.world = record(3, 10).world
        self._orders, self._phases = self.rng.uniform(4.0, 25.0, 8), self.rng.uniform(0.0, 6.28, 8)

    def truth(self, q: Array) -> Array:
        bent = np.sin(np.outer(q[:, ELBOW], self._orders) + self._phases).sum(axis=1) * 7e-5
        turned = q.copy()
        turned[:, ELBOW] += bent + np.where(q[:, ELBOW] > 0.9, 1.2e-3 * np.sin(20.0 * q[:, ELBOW]), 0.0)
        return self.world.tool_in_tracker(turned)

    def recorded(self, dense: int, sparse: int) -> Samples:
        q = postures(self.rng, dense, sparse)
        T = self.truth(q)
        T[:, :3, 3] += 2e-5 * self.rng.standard_normal((len(q), 3))
        return samples_of(ur10(), q, T)


@pytest.mark.slow
def test_a_curve_is_learned_where_few_stations_are() -> None:
    """15 of 615 stations."""
    arm = Bent()
    samples = arm.recorded(600, 15)
    q, truth = samples.q, arm.truth
    wrong = np.flatnonzero(q[:, ELBOW] < 0.6)[:2]
    reading = samples.reading.copy()
    reading[wrong] += 0.01
    samples = replace(samples, reading=reading)
    done = calibrate(samples, ur10(), np.random.default_rng(0), block=1)
    assert any(e.shape.kind == "spline" for e in done.calibration.calibrated.effects)
    fresh = postures(np.random.default_rng(99), 0, 100)
    away = done.calibration.calibrated.predict_samples(samples_of(ur10(), fresh, truth(fresh))) - truth(fresh)
    assert np.sqrt(np.mean(np.sum(away[:, :3, 3] ** 2, axis=1))) < 5e-5  # 0.46 mm where they stay rejected
    assert done.report.wrong[wrong].all()
    # it is said: how many, and where
    again = done.report.readmitted
    assert again.stations >= 3
    assert {p.joint for p in again.places} == {"elbow_joint"}
    assert all(p.low > 0.6 and p.high < 1.26 and p.stations <= p.of <= 15 for p in again.places)
    assert f", {again.stations} taken in again after they had been rejected" in sentence(done.report)
    assert any("taken in again" in note and "elbow_joint" in note for note in done.report.notes)
    assert to_json_data(done.report)["recording"]["readmitted"] == again.stations

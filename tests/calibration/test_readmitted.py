"""Stations that are rejected because a learned curve was not known there are taken in; wrong readings are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, samples_of, ur10

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.final_fit import uncontradicted
from modcal_core.effects.effect import Effect
from modcal_core.effects.shapes import Shape
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.outcome.notes import readmitted_note
from modcal_core.planning.outlook import refit
from modcal_core.report.as_json import to_json_data
from modcal_core.report.words import sentence

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
def test_measuring_says_what_it_takes_in_again() -> None:
    samples = Bent().recorded(300, 10)
    found = refit(samples, ur10(), 0)
    assert found.taken_in.stations >= 3
    assert found.taken_in.unscored == 0
    assert {p.joint for p in found.taken_in.places} == {"elbow_joint"}
    assert not found.wrong[samples.q[:, ELBOW] > 0.9].any()
    (said,) = readmitted_note(found.taken_in)
    assert said.startswith(f"{found.taken_in.stations} stations that the model first missed were taken in again")


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
    assert f", {again.stations} taken in again after that" in sentence(done.report)
    assert any("taken in again" in note and "elbow_joint" in note for note in done.report.notes)
    assert to_json_data(done.report)["recording"]["readmitted"] == again.stations

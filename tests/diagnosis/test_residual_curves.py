"""Small curves of all joints: learned where they predict, as small as they are, and never named; not in a clean arm."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest
from cells import record, samples_of, ur10

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.covariance import likely_sizes
from modcal_core.calibration.fit import Fit
from modcal_core.calibration.model import Model
from modcal_core.calibration.noise import errors
from modcal_core.calibration.starts import fit_geometry
from modcal_core.calibration.store import Calibration
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.diagnosis.residual_curves import with_residual_curves
from modcal_core.effects.registry import claimed, with_companions
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.report.report import to_json_data

NOISE_M = 2e-5
STATIONS, TRAIN = 260, 200


class Weak:
    """Every joint errs by a sum of sines of its own, of so many rad RMS: at the tool less than the noise, each."""

    def __init__(self, seed: int, size: float) -> None:
        self.rng = np.random.default_rng(seed)
        self.world = record(seed, 10, "point").world
        self._orders = self.rng.uniform(1.0, 6.0, (6, 4))
        self._phases = self.rng.uniform(0.0, 6.28, (6, 4))
        self._size = size / np.sqrt(2.0)

    def at(self, count: int, noise: float = 0.0) -> Samples:
        """Points at random postures within a radian."""
        q = self.rng.uniform(-1.0, 1.0, (count, 6))
        bent = self._size * np.sin(q[:, :, None] * self._orders + self._phases).sum(axis=2)
        T = self.world.tool_in_tracker(q + bent)
        T[:, :3, 3] += noise * self.rng.standard_normal((count, 3))
        return samples_of(ur10(), q, T, "point")


def geometry(samples: Samples) -> Fit:
    nominal = fit_cell(ur10(), samples, Cell())
    choice = choose_parameters(nominal.model, views_of(samples), (), ())
    return fit_geometry(nominal.model, samples, choice.parameters, Cell())


def rms(model: Model, samples: Samples) -> float:
    return float(np.sqrt(np.mean(errors(model, samples).position_norm ** 2)))


def divided(samples: Samples) -> tuple[Samples, Samples]:
    rows = np.arange(len(samples))
    return samples.select(rows < TRAIN), samples.select(rows >= TRAIN)


@pytest.mark.parametrize("seed", [11, 12])
def test_weak_curves_of_all_joints_are_learned_together(seed: int) -> None:
    arm = Weak(seed, 2.5e-5)
    train, explain = divided(arm.at(STATIONS, NOISE_M))
    unseen = arm.at(300)
    fit = geometry(train)
    held = with_residual_curves(fit, train, explain)
    assert held is not fit
    assert held.converged
    assert rms(held.model, unseen) < 0.8 * rms(fit.model, unseen)
    assert not any(map(claimed, held.model.effects))
    # numbers that the prior tells are not taken from the equations: the noise is the readings'
    assert held.noise.position == pytest.approx(NOISE_M, rel=0.15)
    assert all(0.0 < e.freedom <= len(e.values) for e in held.model.effects)
    assert sum(e.freedom for e in held.model.effects) < 0.7 * sum(len(e.values) for e in held.model.effects)


@pytest.mark.parametrize("seed", range(21, 25))
def test_a_clean_arm_stays_as_it_is(seed: int) -> None:
    train, explain = divided(Weak(seed, 0.0).at(STATIONS, NOISE_M))
    fit = geometry(train)
    assert with_residual_curves(fit, train, explain) is fit


def test_readings_in_motion_are_left_alone() -> None:
    train, explain = divided(Weak(11, 2.5e-5).at(STATIONS, NOISE_M))
    fit = geometry(train)
    train.moving.flags.writeable = True
    train.moving[0] = True
    assert with_residual_curves(fit, train, explain) is fit


def test_a_report_counts_them_and_names_none(tmp_path: Path) -> None:
    arm = Weak(16, 4e-5)
    done = calibrate(arm.at(180, NOISE_M), ur10(), np.random.default_rng(0))
    effects = done.calibration.calibrated.effects
    small = [i for i, e in enumerate(effects) if not claimed(e)]
    assert small
    data = to_json_data(done.report)
    named = {(e["place"], e["driver"]) for e in data["effects"]}
    assert "residual" not in {e["family"] for e in data["effects"]}
    account = data["account_mm2"]
    nominal = data["error_mm"]["nominal"]["rms"] ** 2
    assert sum(row["value"] for row in account) == pytest.approx(nominal, abs=1e-9)
    of_their_own = [i for i in small if (effects[i].place, effects[i].driver) not in named]
    assert any(row["what"] == "effect:small curves" for row in account) == bool(of_their_own)
    assert any("None of them is claimed as a cause" in note for note in done.report.notes) == bool(of_their_own)
    done.calibration.save(tmp_path / "calibration.yaml")
    again = Calibration.load(tmp_path / "calibration.yaml")
    unseen = arm.at(50)
    assert rms(again.calibrated, unseen) == pytest.approx(rms(done.calibration.calibrated, unseen), rel=1e-9)
    assert [e.held for e in again.calibrated.effects] == [e.held for e in effects]


def test_what_follows_the_same_driver_goes_with_a_named_effect() -> None:
    train, explain = divided(Weak(11, 2.5e-5).at(STATIONS, NOISE_M))
    held = with_residual_curves(geometry(train), train, explain)
    one = held.model.effects[0]
    named = one.__class__("unknown", one.place, one.direction, one.driver, one.shape)
    together = with_companions((named, *held.model.effects), (0,))
    assert {held.model.effects[i - 1].key[1:] for i in together[1:]} == {named.key[1:]}
    assert len(together) > 1


def _evidence(J: Array, r: Array, groups: list[np.ndarray], sizes: tuple[float, ...], noise: float) -> float:
    """Minus twice the logarithm of the likelihood, from the covariance of all residuals."""
    C = noise**2 * np.eye(len(r))
    for own, size in zip(groups, sizes, strict=True):
        C += size**2 * J[own].T @ J[own]
    return float(np.linalg.slogdet(C)[1] + r @ np.linalg.solve(C, r))


def test_sizes_are_those_that_make_the_data_most_likely() -> None:
    rng = np.random.default_rng(4)
    J = rng.standard_normal((45, 300))
    groups = [np.arange(0, 20), np.arange(20, 40), np.arange(40, 45)]
    x = np.r_[0.5 * rng.standard_normal(20), 0.1 * rng.standard_normal(20), np.zeros(5)]
    r = x @ J + 2.0 * rng.standard_normal(300)
    found = likely_sizes(J @ J.T, J @ r, float(r @ r), 300.0, np.ones(45), groups, [0.2, 0.2, 0.2])
    best = _evidence(J, r, groups, found.sizes, found.noise)
    for factors in product((0.7, 1.0, 1.4), repeat=2):
        others = tuple(s * f for s, f in zip(found.sizes, (*factors, 1.0), strict=True))
        assert _evidence(J, r, groups, others, found.noise) > best - 0.1
    assert found.sizes[2] < 0.1
    assert found.noise == pytest.approx(2.0, rel=0.1)
    assert found.sizes[0] == pytest.approx(0.5, rel=0.4)


def test_groups_that_explain_nothing_and_residuals_of_nothing_end_at_nothing() -> None:
    groups = [np.arange(0, 3), np.arange(3, 6)]
    H = np.diag([0.0, 0.0, 0.0, 4.0, 4.0, 4.0])
    for g, square in ((np.zeros(6), 0.0), (np.zeros(6), 50.0), (np.full(6, np.nan), 0.0)):
        found = likely_sizes(H, g, square, 40.0, np.ones(6), groups, [0.2, 0.2])
        assert found.sizes == (0.0, 0.0)

"""What a calibration says of its own uncertainty: right in size, and kept by its file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from calibration.test_effects import started
from cells import NOISE_M, NOISE_RAD, record, samples_of, ur10

from modcal_core.calibration.cell import Cell
from modcal_core.calibration.covariance import uncertainty
from modcal_core.calibration.final_fit import finalise
from modcal_core.calibration.fit import identify
from modcal_core.calibration.linearisation import linearise
from modcal_core.calibration.model import Model
from modcal_core.calibration.store import Calibration, from_data, to_data
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.errors import BadTable
from modcal_core.files import to_yaml
from modcal_core.geometry import se3, so3


def test_it_equals_that_of_the_fit_about_the_same_model() -> None:
    made = record(3, 90)
    model = Model(ur10(), ("tracker",), made.world.T_tracker_base[None], se3.transform(p=[0.05, 0.03, 0.12]))
    parameters = choose_parameters(model, views_of(made.exact)).parameters
    T = model.predict(made.samples.q)
    T[:, :3, 3] += NOISE_M * np.random.default_rng(1).standard_normal((90, 3))
    samples = samples_of(ur10(), made.samples.q, T)
    fit = identify(model, samples, parameters)
    known = uncertainty(fit.model, samples, parameters, fit)
    assert np.abs(known.covariance / fit.covariance - 1.0).max() < 0.02
    assert np.linalg.eigvalsh(known.covariance).min() > 0.0


@pytest.mark.slow
def test_predictions_scatter_as_it_says_with_effects_too() -> None:
    """Many recordings of one truth: squared errors, weighed by the covariance, follow a χ² law."""
    chain = ur10()
    truth = record(4, 1).world
    model = Model(
        chain, ("tracker",), truth.T_tracker_base[None], se3.transform(so3.exp([0.3, 0.1, -0.2]), [0.05, 0.03, 0.1])
    ).with_effects((started("gear"), started("backlash")))
    rng = np.random.default_rng(9)
    q = rng.uniform(-2.0, 2.0, (90, 6))
    here = samples_of(chain, rng.uniform(-2.0, 2.0, (4, 6)), np.tile(np.eye(4), (4, 1, 1)))
    here = replace(here, approach=np.ones_like(here.q))
    T_here = model.predict_samples(here)
    blank = replace(samples_of(chain, q, np.tile(np.eye(4), (90, 1, 1))), approach=rng.choice([-1.0, 1.0], q.shape))
    T = model.predict_samples(blank)
    choice = choose_parameters(model, views_of(blank))
    scores = []
    for _ in range(40):
        samples = replace(
            blank,
            reading=T[:, :3, 3] + NOISE_M * rng.standard_normal((90, 3)),
            R=T[:, :3, :3] @ so3.exp(NOISE_RAD * rng.standard_normal((90, 3))),
        )
        fit = identify(model, samples, choice.parameters)
        known = uncertainty(fit.model, samples, choice.parameters, fit)
        T_fit = fit.model.predict_samples(here)
        seen = replace(here, reading=T_here[:, :3, 3], R=T_here[:, :3, :3])
        values = np.concatenate([np.zeros(len(choice.parameters)), *(e.values for e in fit.model.effects)])
        J = linearise(fit.model, choice.parameters, values, seen).J
        C = J.T @ known.covariance @ J
        one = [0, 4, 8, 12, 16, 20]  # x y z of the first posture, then its turns
        e = np.r_[(T_here - T_fit)[0, :3, 3], so3.log(T_here[0, :3, :3] @ T_fit[0, :3, :3].T)]
        back = np.linalg.inv(model.T_frame_base[0, :3, :3])
        e = np.r_[back @ e[:3], back @ e[3:]]
        scores.append(e @ np.linalg.solve(C[np.ix_(one, one)], e))
    # the mean of 40 χ²(6) is 6 ± 0.55
    assert 6.0 - 2.0 < np.mean(scores) < 6.0 + 2.0


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    made = record(9, 80)
    choice = choose_parameters(
        Model(ur10(), ("tracker",), np.eye(4)[None], se3.transform(p=[0.1, 0.1, 0.1])), views_of(made.samples)
    )
    return finalise(made.samples, ur10(), choice, Cell())


def test_it_survives_its_file(calibration: Calibration) -> None:
    again = from_data(yaml.safe_load(to_yaml(to_data(calibration))))
    assert again.uncertainty is not None
    assert calibration.uncertainty is not None
    assert again.uncertainty.parameters == calibration.uncertainty.parameters
    assert np.array_equal(again.uncertainty.covariance, calibration.uncertainty.covariance)
    assert again.watched == calibration.watched


def test_a_file_without_it_is_read(calibration: Calibration) -> None:
    data = to_data(calibration)
    del data["uncertainty"], data["recorded"]["stamps"]
    again = from_data(data)
    assert again.uncertainty is None
    assert again.watched is None


def test_a_damaged_one_is_refused(calibration: Calibration) -> None:
    data = to_data(calibration)
    rows = data["uncertainty"]["covariance"].splitlines()
    for damaged in (rows[:-1], [*rows[:-1], f"{rows[-1]} 1.0"], [*rows[:-1], "nan" + rows[-1][rows[-1].index(" ") :]]):
        data["uncertainty"]["covariance"] = "\n".join(damaged)
        with pytest.raises(BadTable, match="covariance"):
            from_data(data)
    data["uncertainty"]["covariance"] = "\n".join(["one", *rows[1:]])
    with pytest.raises(BadTable, match="damaged"):
        from_data(data)

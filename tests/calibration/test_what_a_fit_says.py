"""What a fit says beside its values: how much is left, what the data alone knows, and how far a reading is believed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import NOISE_M, NOISE_RAD, Recorded, record, ur10

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.fit import Fit, identify, require_enough
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.errors import NotEnoughData
from modcal_core.geometry import so3
from modcal_core.measurements.samples import Samples


def fitted(samples: Samples) -> Fit:
    start = fit_cell(ur10(), samples, Cell()).model
    return identify(start, samples, choose_parameters(start, views_of(samples)).parameters)


@pytest.mark.slow
def test_what_is_left_counts_what_the_parameters_took() -> None:
    # 18 poses give 108 rows for 30 parameters: without their degrees of freedom the spread would come out at 0.85
    fits = [fitted(record(seed, 18).samples) for seed in range(40)]
    assert np.mean([f.noise.position for f in fits]) == pytest.approx(NOISE_M, rel=0.06)
    assert np.mean([f.noise.rotation for f in fits]) == pytest.approx(NOISE_RAD, rel=0.06)


def test_the_information_is_that_of_the_data_alone() -> None:
    made = record(1, 60, "point")
    still = made.samples.q.copy()
    still[:, 5] = 0.3  # the last joint never moves, so data alone leaves a direction open
    T = made.world.tool_in_tracker(still)
    noise = NOISE_M * np.random.default_rng(2).standard_normal((60, 3))
    fit = fitted(replace(made.samples, q=still, reading=T[:, :3, 3] + noise))
    prior = np.array([p.prior_std for p in fit.parameters])
    # with the prior added it is the inverse of the covariance; in units of the prior, so that sizes compare
    unit = np.outer(prior, prior)
    together = fit.information * unit + np.eye(len(prior))
    assert (fit.covariance / unit) @ together == pytest.approx(np.eye(len(prior)), abs=1e-4)
    seen = np.linalg.eigvalsh(fit.information * unit)
    assert seen[0] < 1e-6 * seen[-1]
    assert seen[0] < 0.5  # less than the prior says


def orientation_error(fit: Fit, made: Recorded) -> float:
    q = np.random.default_rng(99).uniform(-np.pi, np.pi, (200, 6))
    true, said = made.world.tool_in_tracker(q), fit.model.predict(q)
    return float(np.linalg.norm(so3.log(said[:, :3, :3] @ np.swapaxes(true[:, :3, :3], 1, 2)), axis=1).mean())


def test_an_orientation_that_says_it_scatters_is_believed_less() -> None:
    rough = 100.0 * NOISE_RAD
    half, all_ = [], []
    for seed in range(5):
        made = record(seed, 80)
        bad = np.arange(80) % 2 == 0
        noise = so3.exp(rough * np.random.default_rng(seed + 50).standard_normal((80, 3)))
        R = np.where(bad[:, None, None], made.samples.R @ noise, made.samples.R)
        told = replace(made.samples, R=R, sigma_rotation=np.where(bad, rough, 0.0))
        half.append(orientation_error(fitted(made.samples.select(~bad)), made))
        all_.append(orientation_error(fitted(told), made))
    # more readings, so no worse than the good half alone; believed alike, the bad ones would make it many times worse
    assert np.mean(all_) < 1.2 * np.mean(half)


@pytest.mark.slow
@pytest.mark.parametrize("known", [0, 3, 8])
def test_known_distances_stand_for_readings(known: int) -> None:
    samples = record(0, 6).samples  # 36 equations, 1.25 for each parameter are asked for
    most = int((36 + known) / 1.25)
    require_enough(samples, most, known)
    with pytest.raises(NotEnoughData):
        require_enough(samples, most + 1, known)

"""The running estimate is the batch estimate, its covariance is right, and it follows what is allowed to wander."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, samples_of

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.fit import Fit, identify, priors
from modcal_core.calibration.linearisation import linearise
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.shapes import Shape
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_core.online.estimator import Estimator, RandomWalk


def batch(samples: Samples, chain: object, effects: tuple[Effect, ...] = ()) -> Fit:
    cell = fit_cell(chain, samples, Cell())  # type: ignore[arg-type]
    model = cell.model.with_effects(effects)
    parameters = choose_parameters(cell.model, views_of(samples)).parameters
    return identify(model, samples, parameters, robust=False, tolerance=1e-9)


def begun(fit: Fit, samples: Samples) -> Estimator:
    """An estimator that knows what the priors of a batch fit say."""
    _, prior = priors(fit.start.effects, fit.parameters, fit.start.drivers(samples))
    return Estimator(fit.start, fit.parameters, fit.noise, np.diag(prior**2), robust=False)


def feed(estimator: Estimator, samples: Samples) -> None:
    for i in range(len(samples)):
        estimator.update(samples.select(np.array([i])))
    for _ in range(5):
        estimator.linearise_again()


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "count"), [("pose", 300), ("point", 300), ("pose", 1500)])
def test_equals_the_batch_solution(kind: str, count: int) -> None:
    """1500 is more than can be linearised again: what was kept of the rest must do."""
    world = record(3, count, kind)
    fit = batch(world.samples, world.world.nominal)
    estimator = begun(fit, world.samples)
    feed(estimator, world.samples)
    assert np.abs(estimator.values - fit.values).max() < 1e-9
    assert np.abs(estimator.std / fit.std - 1.0).max() < 1e-6
    assert estimator.taken == count


def test_equals_the_batch_solution_with_an_effect() -> None:
    cell = record(4, 250)
    q = cell.samples.q.copy()
    q[:, 2] -= 4e-4 * np.sin(37.0 * q[:, 2] + 0.3)
    samples = samples_of(cell.world.nominal, q, _poses(cell.samples))
    gear = Effect(
        "gear_harmonic", samples.names[2], AXIS, f"position:{samples.names[2]}", Shape("sine", {"cycles": 36.97})
    )
    fit = batch(samples, cell.world.nominal, (gear.started(np.zeros(2) + 1e-5),))
    estimator = begun(fit, samples)
    feed(estimator, samples)
    effect = fit.model.effects[0]
    # the settings' prior stands where they were found, whatever the drivers of the first sample
    assert np.abs(estimator.values[-3:] - effect.values).max() < 1e-7
    assert np.abs(estimator.values[:-3] - fit.values).max() < 1e-9


@pytest.mark.slow
def test_the_stated_covariance_is_right() -> None:
    """Normalised errors of predicted positions over many cells are those of a χ² law."""
    squares = []
    for seed in range(12):
        cell = record(100 + seed, 60)
        fit = batch(cell.samples, cell.world.nominal)
        estimator = begun(fit, cell.samples)
        feed(estimator, cell.samples)
        exact = batch(cell.exact, cell.world.nominal)
        truth = identify(fit.start, cell.exact, fit.parameters, robust=False, tolerance=1e-9)
        assert exact.noise.position < 2e-6  # a tenth of what readings scatter by
        gap = np.linalg.solve(np.linalg.cholesky(estimator.covariance), estimator.values - truth.values)
        squares.append(float(gap @ gap) / len(gap))
    assert 0.8 < np.mean(squares) < 1.25


@pytest.mark.slow
@pytest.mark.parametrize("place", ["base", "tool"])
def test_what_wanders_is_followed(place: str) -> None:
    """Tracker or tool creep by a millimetre, in a direction that a minimal set of parameters does not hold as such."""
    cell = record(6, 400)
    fit = batch(cell.samples, cell.world.nominal)
    T = _poses(cell.samples)
    creep = np.outer(np.linspace(0.0, 1e-3, 400), np.ones(3) / np.sqrt(3.0))
    T[:, :3, 3] += creep if place == "base" else (T[:, :3, :3] @ creep[..., None])[..., 0]
    samples = samples_of(cell.world.nominal, cell.samples.q, T)
    random_walk = RandomWalk((place,), 3e-5, 1e-7)
    stiff = Estimator(fit.model, fit.parameters, fit.noise, fit.covariance)
    free = Estimator(fit.model, fit.parameters, fit.noise, fit.covariance, random_walk, robust=False)
    for estimator in (stiff, free):
        for i in range(len(samples)):
            estimator.update(samples.select(np.array([i])))
    late = samples.select(np.arange(380, 400))
    missed = [np.sqrt(np.mean((e.model.predict(late.q)[:, :3, 3] - late.reading) ** 2)) for e in (stiff, free)]
    assert missed[1] < 1.5 * 5e-5  # the noise of the readings
    assert missed[0] > 2e-4


def test_what_wanders_is_less_sure_by_the_root_of_the_time() -> None:
    """After 25 s without a reading that says anything, the tool may be elsewhere by five times its way of one second."""
    cell = record(6, 60)
    fit = batch(cell.samples, cell.world.nominal)
    random_walk = RandomWalk(("tool",), 3e-4, 1e-7)
    estimator = Estimator(fit.model, fit.parameters, fit.noise, fit.covariance, random_walk)
    row = cell.samples.select(np.array([0]))
    estimator.update(row)
    before = estimator.covariance
    blind = np.full(1, 1e6)
    estimator.update(replace(row, stamps=row.stamps + 25.0, sigma_position=blind, sigma_rotation=blind))
    J = linearise(fit.model, fit.parameters, np.zeros(len(fit.parameters)), row).J[:, :3]
    grown = J.T @ (estimator.covariance - before) @ J
    assert np.abs(grown / (5.0 * random_walk.metres) ** 2 - np.eye(3)).max() < 0.02


def test_an_outlier_is_counted_and_has_no_say() -> None:
    cell = record(7, 200)
    fit = batch(cell.samples, cell.world.nominal)
    wrong = cell.samples.reading.copy()
    wrong[::20] += 0.02
    bad = samples_of(cell.world.nominal, cell.samples.q, se3.transform(cell.samples.R, wrong))
    estimator = Estimator(fit.model, fit.parameters, fit.noise, 100.0 * fit.covariance)
    weights = [estimator.update(bad.select(np.array([i]))) for i in range(200)]
    assert [i for i, weight in enumerate(weights) if weight == 0.0] == list(range(0, 200, 20))
    assert estimator.rejected == 10
    assert np.abs(estimator.values).max() < 6.0 * fit.std.max()


def _poses(samples: Samples) -> Array:
    return se3.transform(samples.R, samples.reading)

"""Identification against MuJoCo: it recovers what was displaced, and its error bars are right."""

from __future__ import annotations

import numpy as np
import pytest
from cells import NOISE_M, record, slider_arm, ur10

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.covariance import identifiability
from modcal_core.calibration.fit import Fit, identify
from modcal_core.calibration.model import Model
from modcal_core.calibration.noise import errors
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.errors import NotEnoughData
from modcal_core.measurements.samples import Samples
from modcal_core.robots.chain import Chain


def fit_all(chain: Chain, samples: Samples, cell: Cell | None = None) -> Fit:
    cell = cell or Cell()
    start = fit_cell(chain, samples, cell).model
    return identify(start, samples, choose_parameters(start, views_of(samples), cell.fixed).parameters)


def position_rms(fit: Fit, q: np.ndarray, T: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum((fit.model.predict(q)[:, :3, 3] - T[:, :3, 3]) ** 2, axis=1))))


@pytest.mark.parametrize("kind", ["pose", "point"])
@pytest.mark.parametrize("chain", [ur10(), slider_arm()], ids=["ur10", "sliders"])
def test_exact_readings_leave_nothing(chain: Chain, kind: str) -> None:
    made = record(3, 120, kind, chain)
    fit = fit_all(chain, made.exact)
    q = made.samples.q[::-1] * 0.7
    assert position_rms(fit, q, made.world.tool_in_tracker(q)) < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("count", [100, 1000, 10_000])
def test_error_on_new_postures_follows_the_law(count: int) -> None:
    """σ √(P / N) for P parameters and N point readings, within 20 %: nothing is wasted and nothing biased."""
    ratios = []
    for seed in range(6):
        made = record(seed, count, "point")
        fit = fit_all(ur10(), made.samples)
        q = np.random.default_rng(seed + 100).uniform(-np.pi, np.pi, (300, 6))
        law = NOISE_M * np.sqrt(len(fit.parameters) / count)
        ratios.append(position_rms(fit, q, made.world.tool_in_tracker(q)) / law)
    assert 0.8 < np.sqrt(np.mean(np.square(ratios))) < 1.2


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pose", "point"])
def test_parameters_lie_within_three_sigma(kind: str) -> None:
    """Over 80 cells, 2 400 values, at least 99 % of the parameters; and 68 % within one sigma: bars are not just wide."""
    scores = []
    for seed in range(80):
        made = record(seed, 100, kind)
        start = fit_cell(ur10(), made.samples, Cell()).model
        parameters = choose_parameters(start, views_of(made.samples)).parameters
        fit = identify(start, made.samples, parameters)
        truth = identify(start, made.exact, parameters, robust=False)
        met = errors(truth.model, made.exact).position_norm  # the exact readings, so these are the true values
        assert met.max() < 1e-8
        scores.append((fit.values - truth.values) / fit.std)
    size = np.abs(np.concatenate(scores))
    assert np.mean(size < 3.0) >= 0.99
    assert 0.62 < np.mean(size < 1.0) < 0.74


def test_outliers_do_not_move_the_fit() -> None:
    made = record(7, 200)
    position = made.samples.reading.copy()
    wrong = np.arange(0, 200, 20)
    position[wrong] += [0.02, -0.03, 0.01]
    from dataclasses import replace

    fit = fit_all(ur10(), replace(made.samples, reading=position))
    assert set(np.flatnonzero(fit.weights == 0.0)) >= set(wrong)
    q = made.samples.q[::-1]
    assert position_rms(fit, q, made.world.tool_in_tracker(q)) < 3e-5


def test_a_joint_that_never_moved_is_named() -> None:
    made = record(1, 150)
    q = made.samples.q.copy()
    q[:, 5] = 0.3
    T = made.world.tool_in_tracker(q)
    from cells import samples_of

    fit = fit_all(ur10(), samples_of(ur10(), q, T))
    seen = identifiability(fit)
    assert seen.rank < seen.parameters
    assert any("wrist_3_joint" in name or "tool" in name for name in seen.unobservable)
    assert np.abs(fit.values).max() < 0.05  # weak directions are held, not let go


def test_too_few_stations_are_refused() -> None:
    made = record(2, 5)
    with pytest.raises(
        NotEnoughData, match="5 stations for 30 parameters: they give 30 equations, at least 38 are needed"
    ):
        fit_all(ur10(), made.samples)


def test_minimal_numbers_of_parameters() -> None:
    """4 per revolute and 2 per sliding joint, 6 at the tool for poses and 3 for points."""
    counts = {}
    for name, chain in {"ur10": ur10(), "sliders": slider_arm()}.items():
        for kind in ("pose", "point"):
            made = record(4, 60, kind, chain)
            start = fit_cell(chain, made.samples, Cell()).model
            counts[name, kind] = len(choose_parameters(start, views_of(made.samples)).parameters)
    assert counts == {("ur10", "pose"): 30, ("ur10", "point"): 27, ("sliders", "pose"): 22, ("sliders", "point"): 19}


def test_fixed_places_stay() -> None:
    made = record(6, 150)
    fit = fit_all(ur10(), made.samples, Cell(fixed=("elbow_joint", "wrist_1_joint/x")))
    names = [p.name for p in fit.parameters]
    assert not [n for n in names if n.startswith("elbow_joint/") or n == "wrist_1_joint/x"]
    assert np.array_equal(fit.model.chain.origins[2], ur10().origins[2])


def test_a_fit_that_is_hopeless_ends_where_that_is_seen() -> None:
    made = record(3, 120, "pose", ur10())
    start = fit_cell(ur10(), made.samples, Cell()).model
    parameters = choose_parameters(start, views_of(made.samples), Cell().fixed).parameters
    steps: list[float] = []

    def hopeless(model: Model, length: float) -> bool:
        steps.append(length)
        assert model.chain.n == start.chain.n
        return len(steps) == 2

    whole = identify(start, made.samples, parameters)
    ended = identify(start, made.samples, parameters, hopeless=hopeless)
    assert len(steps) == ended.iterations == 2 < whole.iterations
    assert steps[1] < steps[0]
    same = identify(start, made.samples, parameters, hopeless=lambda model, length: False)
    assert np.array_equal(same.values, whole.values)

"""Derivatives of every parameter and kind of reading, quick equations against plain ones, and small numerics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, samples_of, slider_arm, ur10
from finite_differences import assert_jacobian
from scipy import stats
from scipy.optimize import nnls

from modcal_core.calibration import fit as fitting
from modcal_core.calibration import noise as distributions
from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.distances import Distance, distance_rows
from modcal_core.calibration.equations import System, nonnegative
from modcal_core.calibration.fit import Curvature, identify
from modcal_core.calibration.linearisation import linearise
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ordered_candidates
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.geometry import se3
from modcal_core.measurements.samples import Samples
from modcal_core.robots.chain import Chain

SHIFT, TURN = 0.01, 0.05  # far from zero, where first order is not enough


def cell(chain: Chain, kinds: tuple[str, ...]) -> tuple[Model, Samples]:
    """Readings of the given kinds, each in a frame of its own, eight postures each."""
    rng = np.random.default_rng(1)
    frames = tuple(f"frame_{k}" for k in range(len(kinds)))
    T = se3.exp(rng.normal(size=(len(kinds), 6)))
    model = Model(chain, frames, T, se3.exp(0.3 * rng.normal(size=6)))
    parts = []
    for k, kind in enumerate(kinds):
        q = rng.uniform(np.maximum(chain.lower, -2), np.minimum(chain.upper, 2), (8, chain.n))
        part = samples_of(chain, q, model.predict(q, np.full(8, k)) @ se3.exp(0.02 * rng.normal(size=(8, 6))), kind)
        parts.append(part)
    joined = {
        name: np.concatenate([getattr(p, name) for p in parts])
        for name in ("q", "stamps", "reading", "R", "kind", "sigma_position", "sigma_rotation", "velocity", "moving")
    }
    frame = np.repeat(np.arange(len(kinds)), 8)
    return model, Samples(chain.names, frames, station=np.arange(8 * len(kinds)), frame=frame, **joined)


@pytest.mark.parametrize(
    ("chain", "kinds"), [(ur10(), ("point",)), (slider_arm(), ("pose",)), (ur10(), ("pose", "point", "pose"))]
)
def test_predictions(chain: Chain, kinds: tuple[str, ...]) -> None:
    model, samples = cell(chain, kinds)
    parameters = ordered_candidates(chain, model.frames, views_of(samples))
    rng = np.random.default_rng(2)
    scale = np.array([SHIFT if p.direction < 3 else TURN for p in parameters])
    x = scale * rng.normal(size=len(parameters))
    at = linearise(model, parameters, x, samples)
    count = at.position.size
    # a frame's own error turns the space that residuals are written in, so those columns are left to the next test
    inner = np.array([k for k, p in enumerate(parameters) if p.place > 0])

    def position(values: np.ndarray) -> np.ndarray:
        full = x.copy()
        full[inner] = values
        return -linearise(model, parameters, full, samples, jacobian=False).position.ravel()

    assert_jacobian(position, at.J[inner, :count].T, x[inner])


@pytest.mark.parametrize(
    ("chain", "kinds"), [(ur10(), ("point",)), (slider_arm(), ("pose",)), (ur10(), ("pose", "point", "pose"))]
)
def test_the_gradient_of_the_cost_is_exact(chain: Chain, kinds: tuple[str, ...]) -> None:
    """For all parameters, although neither the turning frame nor the logarithm is differentiated."""
    model, samples = cell(chain, kinds)
    parameters = ordered_candidates(chain, model.frames, views_of(samples))
    x = np.array([SHIFT if p.direction < 3 else TURN for p in parameters])

    def half_square(values: np.ndarray) -> np.ndarray:
        residual = linearise(model, parameters, values, samples, jacobian=False).residual
        return np.array([0.5 * residual @ residual])

    at = linearise(model, parameters, x, samples)
    assert_jacobian(half_square, -(at.J @ at.residual)[None], x)


def test_distances_between_frames() -> None:
    model, samples = cell(ur10(), ("point", "point", "pose"))
    parameters = ordered_candidates(ur10(), model.frames, views_of(samples))
    known = [Distance(("frame_0", "frame_1"), 0.05), Distance(("frame_2", "frame_1"), 1.0)]
    x = np.array([SHIFT if p.direction < 3 else TURN for p in parameters])
    rows = distance_rows(model, parameters, x, known)
    assert_jacobian(lambda v: -distance_rows(model, parameters, v, known).residual, rows.J.T, x)


@pytest.mark.parametrize("block", [3, 20_000])
@pytest.mark.parametrize(("kinds", "leaders"), [(("pose",), ()), (("point", "point"), ()), (("pose",) * 3, (0, 1, 0))])
def test_normal_equations_are_those_of_the_derivatives(
    kinds: tuple[str, ...], leaders: tuple[int, ...], block: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many samples are taken at once, with weights of their own, of which some are nothing."""
    monkeypatch.setattr("modcal_core.calibration.equations.BLOCK", block)
    model, samples = cell(ur10(), kinds)
    model = replace(model, leaders=leaders)
    parameters = ordered_candidates(model.chain, model.frames, views_of(samples))
    rng = np.random.default_rng(2)
    values = rng.normal(size=len(parameters)) * [TURN if p.turns else SHIFT for p in parameters]
    own = rng.uniform(0.1, 2.0, len(samples)) * (rng.random(len(samples)) > 0.2)
    weight = np.concatenate([np.tile(own, 3), np.tile(own[samples.is_pose], 3)])
    at = linearise(model, parameters, values, samples)
    system = System(model, parameters, samples, model.drivers(samples))
    assert np.abs(system.residuals(values).residual - at.residual).max() < 1e-14
    H, g = system.normal_equations(values, weight)
    expected = (at.J * weight) @ at.J.T
    assert np.abs(H - expected).max() < 1e-12 * np.abs(expected).max()
    assert np.abs(g - (at.J * weight) @ at.residual).max() < 1e-12 * np.abs(g).max()


@pytest.mark.parametrize("kind", ["point", "pose"])
def test_beginning_with_a_few_changes_nothing(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fit of all samples at once is the same fit, and its covariance the same to a thousandth."""
    made = record(6, 1500, kind)
    start = fit_cell(ur10(), made.samples, Cell()).model
    parameters = choose_parameters(start, views_of(made.samples)).parameters
    begun = identify(start, made.samples, parameters)
    monkeypatch.setattr(fitting, "_MANY", 10**9)
    at_once = identify(start, made.samples, parameters)
    assert np.abs((begun.values - at_once.values) / at_once.std).max() < 1e-3
    assert np.abs(begun.std / at_once.std - 1.0).max() < 1e-3
    assert np.abs(begun.weights - at_once.weights).max() < 1e-3


def test_many_at_once_are_as_each_alone(rng: np.random.Generator) -> None:
    X, r = rng.normal(size=(40, 3, 30, 5)), rng.normal(size=(40, 3, 30))
    X[:, 1, :, 1:] *= -1.0
    r[0, 0] = -X[0, 0].sum(axis=1)
    A, v = np.swapaxes(X, -1, -2) @ X, np.einsum("wtki,wtk->wti", X, r)
    x = nonnegative(A, v)
    assert x.shape == v.shape
    for i, j in np.ndindex(40, 3):
        np.testing.assert_allclose(x[i, j], nnls(X[i, j], r[i, j])[0], rtol=1e-7, atol=1e-9)


def test_tails_are_those_of_scipy_stats(rng: np.random.Generator) -> None:
    for z in rng.uniform(-3.0, 30.0, 20):
        assert distributions.beyond_normal(z) == pytest.approx(stats.norm.sf(z), rel=1e-12)
        for m in (1, 3, 40):
            assert distributions.beyond_chi2(z + 4.0, m) == pytest.approx(stats.chi2.sf(z + 4.0, m), rel=1e-12)
            assert distributions.median_chi2(m) == pytest.approx(stats.chi2.ppf(0.5, m), rel=1e-12)
            for share in (0.05, 0.9, 0.999):
                assert distributions.quantile_chi2(share, m) == pytest.approx(stats.chi2.ppf(share, m), rel=1e-12)
                tiny = 1e-9 * share
                assert distributions.exceeded_chi2(tiny, m) == pytest.approx(stats.chi2.isf(tiny, m), rel=1e-12)
    x = np.geomspace(1e-3, 1e4, 50)
    ours = distributions.log10_beyond_f(x, 3, 200)
    theirs = stats.f.logsf(x, 3, 200) / np.log(10.0)
    assert np.array_equal(np.isfinite(ours), np.isfinite(theirs))
    assert np.allclose(ours[np.isfinite(ours)], theirs[np.isfinite(ours)], rtol=1e-11)


@pytest.mark.parametrize("count", [2, 19, 400])
def test_the_law_of_largest_values_is_fitted_as_by_scipy_stats(count: int, rng: np.random.Generator) -> None:
    for location, scale in ((3.0, 0.5), (-20.0, 4.0), (1e3, 1e-2)):
        x = rng.gumbel(location, scale, count)
        ours, theirs = distributions.gumbel_of(x), stats.gumbel_r.fit(x)
        assert ours == pytest.approx(theirs, rel=1e-6)
        # no other law of this kind makes the numbers more likely
        best = stats.gumbel_r.logpdf(x, *ours).sum()
        assert best >= stats.gumbel_r.logpdf(x, *theirs).sum() - 1e-9 * abs(best)
        far = location + 12.0 * scale
        assert distributions.beyond_gumbel(far, *ours) == pytest.approx(stats.gumbel_r.sf(far, *ours), rel=1e-9)


def test_solution_and_inverse_at_units_far_apart() -> None:
    """Values of which one is a thousand million times as large as another."""
    rng = np.random.default_rng(0)
    J = rng.normal(size=(40, 12)) * 10.0 ** np.linspace(-5, 4, 12)
    H, g = J.T @ J, J.T @ rng.normal(size=40)
    curvature = Curvature.of(H)
    size = np.sqrt(np.diag(H))
    expected = np.linalg.lstsq(J / size, np.linalg.pinv((J / size).T) @ (g / size), rcond=None)[0] / size
    np.testing.assert_allclose(curvature.solve(g), expected, rtol=1e-9)
    np.testing.assert_allclose((H @ curvature.inverse()) * size / size[:, None], np.eye(12), atol=1e-9)
    np.testing.assert_array_equal(curvature.inverse(), curvature.inverse().T)


def test_what_is_singular_has_a_solution() -> None:
    """Two columns are the same: the step is shared between them, and solves the equations."""
    J = np.random.default_rng(2).normal(size=(30, 4))
    J = np.concatenate([J, J[:, :1]], axis=1)
    H, g = J.T @ J, J.T @ np.ones(30)
    step = Curvature.of(H).solve(g)
    np.testing.assert_allclose(H @ step, g, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(step[0], step[4], rtol=1e-3, atol=1e-5)

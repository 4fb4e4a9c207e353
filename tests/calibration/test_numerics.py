"""Small numerics against SciPy and NumPy: nonnegative least squares, tails, factors and their inverses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import nnls

from modcal_core.calibration import noise as distributions
from modcal_core.calibration.equations import nonnegative
from modcal_core.calibration.fit import Curvature, inverse_of_triangle


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


@pytest.mark.parametrize("rows", [0, 1, 63, 64, 65, 200])
def test_it_is_the_inverse_and_reads_nothing_above_the_diagonal(rows: int) -> None:
    rng = np.random.default_rng(rows)
    lower = np.tril(rng.normal(size=(rows, rows))) + 2.0 * np.sqrt(rows) * np.eye(rows)
    written_above = np.asfortranarray(lower + np.triu(np.full((rows, rows), np.nan), 1))
    inverse = inverse_of_triangle(written_above)
    np.testing.assert_allclose(inverse @ lower, np.eye(rows), atol=1e-12)
    np.testing.assert_array_equal(np.triu(inverse, 1), 0.0)

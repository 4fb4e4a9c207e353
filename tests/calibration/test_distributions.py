"""Tails of distributions against those of scipy.stats."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from modcal_core.calibration import noise as distributions


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

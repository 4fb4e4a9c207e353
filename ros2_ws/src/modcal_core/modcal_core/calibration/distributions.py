"""How likely noise is to do as much: the tails of the distributions that evidence is weighed with.

Written on ``scipy.special``: ``scipy.stats`` takes longer to import than most questions take to answer. SciPy loads
what is named after it when that is first used, so what only reads a calibration does without.
"""

from __future__ import annotations

import numpy as np
import scipy

from modcal_core.geometry.so3 import Array


def beyond_normal(z: float) -> float:
    """The chance that a standard normal number is greater than z."""
    return float(scipy.special.ndtr(-z))


def beyond_chi2(x: float, freedom: int) -> float:
    """Survival function of the chi-square distribution: the chance of a value greater than x."""
    return float(scipy.special.chdtrc(freedom, x))


def as_normal(square: float, freedom: int) -> float:
    """Two-sided standard normal quantile with the same chance as a chi-square value."""
    chance = beyond_chi2(square, freedom)
    return float(-scipy.special.ndtri(0.5 * chance)) if chance > 1e-300 else float(np.sqrt(square))


def median_chi2(freedom: int) -> float:
    """Median of the chi-square distribution."""
    return float(2.0 * scipy.special.gammaincinv(0.5 * freedom, 0.5))


def quantile_chi2(share: float, freedom: float) -> float:
    """Quantile of the chi-square distribution: stays below it with probability ``share``."""
    return float(2.0 * scipy.special.gammaincinv(0.5 * freedom, share))


def exceeded_chi2(chance: float, freedom: int) -> float:
    """Quantile of the chi-square distribution that is exceeded with a probability, which may be tiny."""
    return float(scipy.special.chdtri(freedom, chance))


def log10_beyond_f(x: Array, m: int, freedom: int) -> Array:
    """log10 of the chance that a ratio of mean squares, over m and over freedom numbers, is greater than x."""
    with np.errstate(divide="ignore"):
        return np.asarray(np.log10(scipy.special.fdtrc(m, freedom, x)))


def gumbel_of(x: Array) -> tuple[float, float]:
    """(location, scale) of the law of largest values that makes these numbers (n,) most likely; they must differ.

    The scale s solves s = x̄ − Σ x e^(−x/s) / Σ e^(−x/s), whose two sides cross once; then the location is
    −s log mean e^(−x/s) (Johnson, Kotz, Balakrishnan, Continuous Univariate Distributions 2, ch. 22).
    """
    mean, y = float(x.mean()), x - float(x.min())

    def excess(s: float) -> float:
        w = np.exp(-y / s)
        return s - mean + float((x * w).sum() / w.sum())

    low, high = 1e-6 * float(y.max()), float(y.max())
    while high - low > 1e-13 * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(middle) < 0.0 else (low, middle)
    scale = 0.5 * (low + high)
    return float(x.min()) - scale * float(np.log(np.mean(np.exp(-y / scale)))), scale


def beyond_gumbel(x: float, location: float, scale: float) -> float:
    """The chance that a number of this law of largest values is greater than x."""
    return float(-np.expm1(-np.exp(-(x - location) / scale)))

"""How large the residuals are, and how much each one counts.

Every reading has its own scatter (known from the dwell, or not), and on top of it the arm misses by an amount that no
reading knows: gears, repeatability. The variance of a residual is ``s² + σ_i²``, with one s for positions and one for
orientations, found so that the weighted sum of squares equals the degrees of freedom (Paule & Mandel 1982). A sample
far outside, judged by its whole residual against a χ² law, counts less (Huber) and beyond a limit not at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration.chances import median_chi2
from modcal_core.geometry.so3 import Array

HUBER_Z = 2.5  # standard scores; a Gaussian sample passes this once in 160
REJECT_Z = 6.0
_FLOOR = 1e-9  # m or rad; exact data must not divide by zero


@dataclass(frozen=True)
class Spread:
    """Standard deviations that no reading explains, per axis: position [m], rotation [rad]."""

    position: float
    rotation: float


def robust_spread(position: Array, rotation: Array) -> Spread:
    """The spread of residuals (3, N) and (3, M) by their medians: half of the samples may be wrong."""
    median3 = float(np.sqrt(median_chi2(3)))

    def one(r: Array) -> float:
        return max(float(np.median(np.sqrt(np.einsum("ij,ij->j", r, r)))) / median3, _FLOOR) if r.size else _FLOOR

    return Spread(one(position), one(rotation))


def excess_spread(residual: Array, known: Array, weight: Array, lost: float) -> float:
    """s for residuals (3, N) with known deviations (N,) and robust weights (N,), ``lost`` degrees of freedom spent."""
    if not residual.size:
        return _FLOOR
    square = np.einsum("ij,ij->j", residual, residual)
    freedom = max(3.0 * float(weight.sum()) - lost, 1.0)
    if not known.any():
        return max(float(np.sqrt(weight @ square / freedom)), _FLOOR)
    s2 = float(weight @ square) / freedom
    for _ in range(50):  # the sum falls monotonically in s², and is convex: Newton from above never overshoots zero
        v = s2 + known**2
        miss = float((weight * square / v).sum()) - freedom
        slope = -float((weight * square / v**2).sum())
        new = max(s2 - miss / slope, 0.0) if slope else 0.0
        if abs(new - s2) <= 1e-12 * max(s2, _FLOOR**2):
            break
        s2 = new
    return max(float(np.sqrt(s2)), _FLOOR)


def standard_score(square: Array, dimensions: Array) -> Array:
    """Approximate standard scores of χ² values (N,) with these degrees of freedom (N,) (Wilson & Hilferty 1931)."""
    c = 2.0 / (9.0 * dimensions)
    return (np.cbrt(square / dimensions) - (1.0 - c)) / np.sqrt(c)


def robust_weights(z: Array) -> Array:
    """Weights in [0, 1] for standard scores: 1 inside, falling as 1/z, then 0 where a sample is rejected."""
    w = np.minimum(1.0, HUBER_Z / np.maximum(z, HUBER_Z))
    return np.where(z > REJECT_Z, 0.0, w)

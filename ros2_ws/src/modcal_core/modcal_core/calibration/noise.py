"""How large the residuals are, and how much each one counts.

Every reading has its own scatter (known from the dwell, or not), and on top of it the arm misses by an amount that no
reading knows: gears, repeatability. The variance of a residual is ``s² + σ_i²``, with one s for positions and one for
orientations, found so that the weighted sum of squares equals the degrees of freedom (Paule & Mandel 1982). A sample
far outside, judged by its whole residual against a χ² law, counts less (Huber) and beyond a limit not at all.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from math import cbrt, sqrt

import numpy as np

from modcal_core.calibration.distributions import median_chi2
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.kinds.registry import kinds
from modcal_core.measurements.kinds.rows import indirect_rows
from modcal_core.measurements.samples import Samples

HUBER_Z = 2.5  # standard scores; a Gaussian sample passes this once in 160
REJECT_Z = 6.0  # standard scores; a Gaussian sample passes this once in 10⁹, so what is rejected is no noise
_FLOOR = 1e-9  # m or rad; exact data must not divide by zero


@dataclass(frozen=True)
class NoiseModel:
    """Standard deviations that no reading explains, per axis: position [m], rotation [rad], and of readings that are
    no positions, by kind and in its unit.
    """

    position: float
    rotation: float
    others: dict[str, float] = field(default_factory=dict)

    def of(self, samples: Samples) -> Array | float:
        """Noise (N,) of each sample's position or scalar reading, or one number for all."""
        if not self.others:
            return self.position
        out = np.full(len(samples), self.position)
        for kind, size in self.others.items():
            out[samples.kind == kind] = size
        return out


@dataclass(frozen=True)
class Groups:
    """Samples by what shares its noise. positions: rows (or all). others: rows by kind, of those that are no positions.
    dimensions: directions in which each sample sees, (N,).
    """

    positions: np.ndarray | slice
    others: dict[str, np.ndarray]
    dimensions: Array

    @classmethod
    def of(cls, samples: Samples, mixed: bool) -> Groups:
        """The groups of these samples. mixed: whether there may be readings that are no positions."""
        dimensions = np.where(samples.is_pose, 6.0, 3.0)
        if not mixed or not (indirect := indirect_rows(samples)).any():
            return cls(slice(None), {}, dimensions)
        others = {}
        for name in np.unique(samples.kind[indirect]).tolist():
            others[name] = np.flatnonzero(samples.kind == name)
            dimensions[others[name]] = kinds()[name].dimensions
        return cls(np.flatnonzero(~indirect), others, dimensions)

    @cached_property
    def rows(self) -> float:
        """Equations that the samples give."""
        return float(self.dimensions.sum())


def robust_noise(position: Array, rotation: Array, groups: Groups | None = None) -> NoiseModel:
    """The noise of residuals (3, N) and (3, M) by their medians: half of the samples may be wrong."""

    def one(r: Array, dimensions: int = 3) -> float:
        usual = float(np.sqrt(median_chi2(dimensions)))
        return max(float(np.median(np.sqrt(np.einsum("ij,ij->j", r, r)))) / usual, _FLOOR) if r.size else _FLOOR

    if groups is None or not groups.others:
        return NoiseModel(one(position), one(rotation))
    others = {name: one(position[:, rows], kinds()[name].dimensions) for name, rows in groups.others.items()}
    return NoiseModel(one(position[:, groups.positions]), one(rotation), others)


def excess_sigma(square: Array, known: Array, weight: Array, lost: float, dimensions: int = 3) -> float:
    """s for squares (N,) of residuals with known deviations (N,) and robust weights (N,), ``lost`` degrees of freedom
    spent.
    """
    if not square.size:
        return _FLOOR
    freedom = max(dimensions * float(weight.sum()) - lost, 1.0)
    if not known.any():
        return max(float(np.sqrt(weight @ square / freedom)), _FLOOR)
    s2 = float(weight @ square) / freedom
    # the sum falls monotonically in s², and is convex: Newton's steps end at its root. From above they can pass zero,
    # where the sum is infinite if a reading has no deviation of its own: then they must stay above it.
    shrink = 0.0 if known.all() else 0.1
    for _ in range(100):
        v = s2 + known**2
        miss = float((weight * square / v).sum()) - freedom
        slope = -float((weight * square / v**2).sum())
        new = max(s2 - miss / slope, shrink * s2, _FLOOR**2 if shrink else 0.0) if slope else 0.0
        if abs(new - s2) <= 1e-12 * max(s2, _FLOOR**2):
            break
        s2 = new
    return max(float(np.sqrt(s2)), _FLOOR)


def standard_score(square: Array | float, dimensions: Array | float) -> Array:
    """Approximate standard scores of χ² values (N,) with these degrees of freedom (N,) (Wilson & Hilferty 1931)."""
    c = 2.0 / (9.0 * dimensions)
    return np.asarray((np.cbrt(square / dimensions) - (1.0 - c)) / np.sqrt(c))


def score_of_one(square: float, dimensions: int) -> float:
    """:func:`standard_score` of a single χ² value, without arrays: where samples come one by one."""
    c = 2.0 / (9.0 * dimensions)
    return (cbrt(square / dimensions) - (1.0 - c)) / sqrt(c)


def robust_weights(z: Array, limit: float = REJECT_Z) -> Array:
    """Weights in [0, 1] for standard scores: 1 inside, falling as 1/z, then 0 beyond the limit: a rejected sample."""
    w = np.minimum(1.0, HUBER_Z / np.maximum(z, HUBER_Z))
    return np.where(z > limit, 0.0, w)

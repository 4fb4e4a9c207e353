"""How well a calibrated model is known: one covariance of its geometry and its effects together.

Amplitudes of effects and constants of the arm share what the data says (a sag that grows with load is half a joint
zero), so their variances alone would say too much or too little of a predicted pose. The values are small deviations
about the calibrated model *as it is written*, after its gauge has been chosen, so that no second model is needed to
read them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from modcal_core.calibration.curvature import inverse_of_triangle
from modcal_core.calibration.distances import AnyDistance, distance_rows
from modcal_core.calibration.identify import Fit
from modcal_core.calibration.linearise import linearise
from modcal_core.calibration.model import Model
from modcal_core.calibration.normal_equations import blocks_at, normal_equations
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.calibration.shared_noise import has_shared_noise, shared_noise
from modcal_core.calibration.weights import row_weights
from modcal_core.effects.effect import prior_stds
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples


@dataclass(frozen=True)
class Uncertainty:
    """Covariance of deviations from a model.

    parameters: P of the geometry, each one direction at one place (see :mod:`modcal_core.calibration.parameters`), zero
    at the model itself. covariance: (K, K), of the parameters [m, rad], then of the values of the model's effects in
    their order.
    """

    parameters: tuple[ModelParameter, ...]
    covariance: Array

    @property
    def std(self) -> Array:
        """Standard deviations, (K,)."""
        return np.sqrt(np.diag(self.covariance))


def uncertainty(
    model: Model,
    samples: Samples,
    parameters: Sequence[ModelParameter],
    fit: Fit,
    distances: Sequence[AnyDistance] = (),
) -> Uncertainty:
    """The uncertainty of these parameters about a model, and of its effects, as these samples leave it.

    fit: of the same samples, whose weights and noise count. It is the inverse of JᵀWJ with the priors added.
    """
    P = len(parameters)
    values = np.concatenate([np.zeros(P), *(e.values for e in model.effects)])
    around = model.drivers(samples)
    prior = np.concatenate([[p.prior_std for p in parameters], *(prior_stds(e, around) for e in model.effects)])
    weight = row_weights(fit.weights, fit.noise, samples)
    H, _ = normal_equations(model, parameters, values, samples, weight, blocks_at(samples, around))
    if has_shared_noise(samples):
        left = linearise(model, parameters, values, samples, jacobian=False, drivers=around)
        H /= shared_noise(samples, left, weight)
    if distances:
        rows = distance_rows(model, parameters, values, distances)
        H += (rows.J / rows.std**2) @ rows.J.T
    H += np.diag(prior**-2.0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    H = H * np.outer(scale, scale)
    lower, singular = scipy.linalg.lapack.dpotrf(H.T, lower=1, clean=0)
    if singular:  # to rounding
        inverse = np.asarray(np.linalg.pinv(H, rcond=1e-12, hermitian=True), dtype=float)
        covariance = inverse * np.outer(scale, scale)
        return Uncertainty(tuple(parameters), 0.5 * (covariance + covariance.T))
    half = inverse_of_triangle(lower) * scale
    return Uncertainty(tuple(parameters), half.T @ half)

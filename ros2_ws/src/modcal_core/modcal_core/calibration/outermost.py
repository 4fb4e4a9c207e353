"""Whether geometry alone is the better model outside what was seen: asked of the recording's own outermost postures.

Both models are fitted to the inner postures, as far as curves depend on their joints, and judged on the outer fifth.
They are linear in small deviations, so leaving out is a step in closed form: with A the curvature of the whole fit,
prior included, and J, r the weighted derivatives and residuals of what is left out, it moves the values by
−(A − JJᵀ)⁻¹Jr. Where the full model then hardly knows itself, it is doubted for that (:mod:`doubt`), and not judged.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.calibration.distances import AnyDistance, distance_rows
from modcal_core.calibration.doubt import UNSURE
from modcal_core.calibration.fallback import curved_joints
from modcal_core.calibration.identify import Fit
from modcal_core.calibration.linearise import linearise
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.calibration.weights import row_weights
from modcal_core.effects.effect import prior_stds
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_core.measurements.thinning import spread_rows

_OUTER = 0.2  # share of the postures, as much as is held out of a usual recording
_MIN_JUDGED = 12  # samples; fewer say nothing
_MAX = 1500  # samples, for time
_DRAWN_IN = 25.0  # of the median square, so that no wrong reading decides


def geometry_is_better(
    full: Model,
    alone: Model,
    samples: Samples,
    parameters: Sequence[ModelParameter],
    fit: Fit,
    distances: Sequence[AnyDistance] = (),
) -> bool:
    """Whether, of two models fitted to the inner postures, geometry alone misses the outer ones by less.

    full, alone: fitted to all samples. fit: of the full one. False where no curves are, or readings do not say.
    """
    curved = curved_joints(full.effects, full.chain.names)
    if not curved.any():
        return False
    rows = spread_rows(len(samples), _MAX)
    few = samples.select(rows)
    q = few.q[:, curved]
    away = np.abs(q - 0.5 * (q.max(axis=0) + q.min(axis=0))) / np.maximum(np.ptp(q, axis=0), 1e-12)
    outer = away.max(axis=1)
    outside = outer > np.quantile(outer, 1.0 - _OUTER)
    weight = row_weights(fit.weights[rows], fit.noise, few)
    (geometry, _, left), (curves, variance, _) = (
        _left_out(model, few, parameters, weight, distances, outside) for model in (alone, full)
    )
    sure = variance < UNSURE * left
    if sure.sum() < _MIN_JUDGED:
        return False
    limit = _DRAWN_IN * float(np.median(curves[sure]))
    return bool(np.minimum(geometry[sure], limit).mean() < np.minimum(curves[sure], limit).mean())


def _left_out(
    model: Model,
    samples: Samples,
    parameters: Sequence[ModelParameter],
    weight: Array,
    distances: Sequence[AnyDistance],
    out: np.ndarray,
) -> tuple[Array, Array, float]:
    """Squared residuals of the positions of some samples (N,) once these are left out of the fit, the variances that
    the values' uncertainty then gives their predictions, and the mean square of all residuals as they were.
    """
    drivers, P, N = model.drivers(samples), len(parameters), len(samples)
    values = np.concatenate([np.zeros(P), *(e.values for e in model.effects)])
    prior = np.concatenate([[p.prior_std for p in parameters], *(prior_stds(e, drivers) for e in model.effects)])
    at = linearise(model, parameters, values, samples, drivers=drivers)
    J, residual = at.J * np.sqrt(weight), at.residual * np.sqrt(weight)
    A = J @ J.T + np.diag(prior**-2.0)
    if distances:
        rows = distance_rows(model, parameters, values, distances)
        A += (rows.J / rows.std**2) @ rows.J.T
    which = np.concatenate([np.tile(out, 3), np.tile(out[samples.is_pose], 3)])
    B = A - J[:, which] @ J[:, which].T
    scale = 1.0 / np.sqrt(np.maximum(np.diag(B), 1e-300))
    C = np.linalg.pinv(B * np.outer(scale, scale), rcond=1e-12, hermitian=True) * np.outer(scale, scale)
    step = -C @ (J[:, which] @ residual[which])
    at_out = np.flatnonzero(np.tile(out, 3))
    missed = (residual[at_out] - step @ J[:, at_out]).reshape(3, -1)
    variance = np.einsum("kr,kr->r", J[:, at_out], C @ J[:, at_out]).reshape(3, -1)
    usual = float(np.mean(np.sum(residual[: 3 * N].reshape(3, -1) ** 2, axis=0)))
    return np.sum(missed**2, axis=0), variance.sum(axis=0), usual

"""A step of Gauss and Newton of what pulls on an arm, the arm and its effects free."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.calibration import Fit, RowView, linearise, row_weights
from modcal_core.diagnosis.load_hypothesis import LoadHypothesis
from modcal_core.effects import Drivers, Effect, Term, motion, prior_stds
from modcal_core.geometry import Array
from modcal_core.measurements import Samples, spread_rows

_MAX_FITTED = 1000  # samples that what pulls is fitted to, for time


def step_of(fit: Fit, samples: Samples, asked: LoadHypothesis, x: Array) -> tuple[Array, Array]:
    """A step of Gauss and Newton (k,) of what pulls, the arm and its effects free, and the covariance (k, k)."""
    rows = spread_rows(len(samples), _MAX_FITTED)
    few, model, P = samples.select(rows), fit.model, len(fit.parameters)
    weight = row_weights(fit.weights[rows] * (len(samples) / len(rows)), fit.noise, few)
    drivers = model.drivers(few)
    values = np.concatenate([np.zeros(P), *(e.values for e in model.effects)])
    now = linearise(model, fit.parameters, values, few, drivers=drivers)
    view = RowView.of(model, few, drivers)
    J = np.concatenate([now.J, _load_rows(view, model.effects, few, asked, x)])
    prior = np.concatenate(
        [[p.prior_std for p in fit.parameters], *(prior_stds(e, drivers) for e in model.effects), asked.prior_std]
    )
    JW = J * weight
    H = JW @ J.T + np.diag(prior**-2.0)
    g = JW @ now.residual
    k = len(H) - asked.size
    g[:k] = 0.0  # the fit is where its own gradient ends
    g[k:] -= x / asked.prior_std**2
    scale = 1.0 / np.sqrt(np.diag(H))
    covariance = np.linalg.pinv(H * np.outer(scale, scale), rcond=1e-12, hermitian=True) * np.outer(scale, scale)
    return (covariance @ g)[k:], covariance[k:, k:]


def _load_rows(view: RowView, effects: Sequence[Effect], samples: Samples, asked: LoadHypothesis, x: Array) -> Array:
    """Motion of the tool per unit of each number, (k, 3 N + 3 M)."""
    springs = tuple(effect for effect in effects if by_weight(effect))
    rows = []
    for i, step in enumerate(asked.steps):
        d = step * (np.arange(asked.size) == i)
        up, down = (motion(springs, Drivers(samples, asked.pulled(x + s * d)))[0] for s in (1.0, -1.0))
        terms = [
            Term(place, direction, (up[place][direction] - down[place][direction]) / (2.0 * step))
            for place in up
            for direction in range(6)
            if (up[place][direction] != down[place][direction]).any()
        ]
        rows.append(view.moved_by(terms))
    return np.stack(rows)


def by_weight(effect: Effect) -> bool:
    """Whether an effect goes by a load that is computed from weight."""
    return effect.driver.partition(":")[0] in ("load", "payload", "moment") or effect.driver.startswith("offset_")

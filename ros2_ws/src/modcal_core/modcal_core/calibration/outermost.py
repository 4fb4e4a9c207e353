"""How far outside what was seen the full model is better than geometry alone: asked of the recording's own ends.

Of each joint that a curve depends on, some of the postures at either end of its range are left out of the fit of either
model, which is then judged on them; so are more of them, and more. A model that is better however many are left out is
trusted wherever the joint goes. One that is better up to some depth is trusted as far beyond the range as that depth
was, and one that is not, nowhere. A curve is nothing where it was not fitted, as outside the range.

Both models are linear in small deviations, so leaving out is a step in closed form: with A the curvature of the whole
fit, prior included, and J, r the weighted derivatives and residuals of what is left out, it moves the values by
−(A − JJᵀ)⁻¹Jr. What of an effect is then not seen any more is expected to be as large as it is elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.calibration.distances import AnyDistance, distance_rows
from modcal_core.calibration.doubt import UNSURE
from modcal_core.calibration.fallback import curved_joints
from modcal_core.calibration.identify import Fit, row_weights
from modcal_core.calibration.linearise import linearise
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.effects.effect import Effect, prior_stds
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples

_DEPTHS = (0.15, 0.3, 0.45)  # shares of the postures, at either end; with more than half left out little is left to fit
_LEAST_LEFT = 0.4  # share of the postures: joints with few positions leave out more than asked
_LEAST_JUDGED = 12  # samples; fewer say nothing
_MOST = 1500  # samples, for time
_DRAWN_IN = 25.0  # of the median square, so that no wrong reading decides


def trusted_beyond(
    full: Model,
    alone: Model,
    samples: Samples,
    parameters: Sequence[ModelParameter],
    fit: Fit,
    distances: Sequence[AnyDistance] = (),
) -> Array:
    """How far below and above what was seen of each joint the full model is the better one, (2, n) [rad, m].

    full, alone: the models with all effects and with geometry alone, as they were fitted to all samples. fit: of the
    full one. Infinite where it is better however much was left out, and for joints that no curve depends on.
    """
    curved = curved_joints(full.effects, full.chain.names)
    out = np.full((2, len(curved)), np.inf)
    if not curved.any():
        return out
    rows = np.unique(np.linspace(0, len(samples) - 1, min(len(samples), _MOST)).astype(int))
    few = samples.select(rows)
    weight = row_weights(fit.weights[rows], fit.noise, few)
    both = [_Linear.of(model, few, parameters, weight, distances) for model in (alone, full)]
    for j in np.flatnonzero(curved):
        fading = _splines(full, full.chain.names[j], len(parameters))
        for side, x in enumerate((few.q[:, j], -few.q[:, j])):
            out[side, j] = _trusted(both[0], both[1], x, fading)
    return out


def _trusted(alone: _Linear, full: _Linear, x: Array, fading: np.ndarray) -> float:
    """How far below the smallest of x (N,) the full model is better. fading: its values that are nothing there."""
    last = 0.0
    for depth in _DEPTHS:
        below = x <= np.quantile(x, depth)
        if np.mean(~below) < _LEAST_LEFT:
            break
        geometry, _ = alone.missed(below, fading[:0])
        curves, variance = full.missed(below, fading)
        sure = variance < UNSURE * alone.square  # elsewhere the model knows by itself that it knows little
        if sure.sum() < _LEAST_JUDGED:
            break
        geometry, curves = geometry[sure], curves[sure]
        limit = _DRAWN_IN * float(np.median(curves))
        if np.minimum(curves, limit).mean() >= np.minimum(geometry, limit).mean():
            return last
        last = float(x[~below].min() - x.min())
    return np.inf


def _splines(model: Model, joint: str, first: int) -> np.ndarray:
    """Where among the values, from the first effect's on, the amplitudes of splines over a joint are."""
    ends = first + np.cumsum([0, *(len(e.values) for e in model.effects)])
    of = [
        np.arange(ends[i], ends[i] + len(e.amplitudes))
        for i, e in enumerate(model.effects)
        if e.shape.kind == "spline" and f"position:{joint}" in e.driver.split(",")
    ]
    return np.concatenate([np.zeros(0, int), *of])


def _usual(effect: Effect) -> Array:
    """RMS of an effect's amplitudes, for each of them, and nothing for its settings."""
    amplitudes = effect.amplitudes
    out = np.full(len(effect.values), np.inf)
    out[: len(amplitudes)] = max(float(np.sqrt(np.mean(amplitudes**2))), 1e-300)
    return out


@dataclass(frozen=True)
class _Linear:
    """A fitted model about its end: curvature A (K, K), weighted derivatives of positions and orientations (K, 3, N)
    and residuals (3, N) of each, zero where there is no orientation, the values of its effects (K,) and how large they
    usually are (K,), infinite where that says nothing.
    """

    A: Array
    J: tuple[Array, Array]
    residual: tuple[Array, Array]
    values: Array
    usual: Array

    @classmethod
    def of(
        cls,
        model: Model,
        samples: Samples,
        parameters: Sequence[ModelParameter],
        weight: Array,
        distances: Sequence[AnyDistance],
    ) -> _Linear:
        drivers, P, N = model.drivers(samples), len(parameters), len(samples)
        values = np.concatenate([np.zeros(P), *(e.values for e in model.effects)])
        prior = np.concatenate([[p.prior_std for p in parameters], *(prior_stds(e, drivers) for e in model.effects)])
        at = linearise(model, parameters, values, samples, drivers=drivers)
        J, residual = at.J * np.sqrt(weight), at.residual * np.sqrt(weight)
        A = J @ J.T + np.diag(prior**-2.0)
        usual = np.concatenate([np.full(P, np.inf), *(_usual(e) for e in model.effects)])
        if distances:
            rows = distance_rows(model, parameters, values, distances)
            A += (rows.J / rows.std**2) @ rows.J.T
        turned = np.zeros((len(J) + 1, 3, N))
        turned[..., samples.is_pose] = np.concatenate([J, residual[None]])[:, 3 * N :].reshape(len(J) + 1, 3, -1)
        return cls(
            A,
            (J[:, : 3 * N].reshape(-1, 3, N), turned[:-1]),
            (residual[: 3 * N].reshape(3, N), turned[-1]),
            values,
            usual,
        )

    @property
    def square(self) -> float:
        """Mean square of the positions' residuals."""
        return float(np.mean(np.sum(self.residual[0] ** 2, axis=0)))

    def missed(self, rows: np.ndarray, gone: np.ndarray) -> tuple[Array, Array]:
        """Squared residuals of positions at these rows (N,) once they are left out, these values being nothing there,
        and the variances that the values' uncertainty gives their predictions.
        """
        J = np.concatenate([part[..., rows].reshape(len(self.A), -1) for part in self.J], axis=1)
        residual = np.concatenate([part[:, rows].ravel() for part in self.residual])
        B = self.A - J @ J.T + np.diag(self.usual**-2.0)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(B), 1e-300))
        C = np.linalg.pinv(B * np.outer(scale, scale), rcond=1e-12, hermitian=True) * np.outer(scale, scale)
        step = -C @ (J @ residual + self.values * self.usual**-2.0)
        step[gone] = -self.values[gone]
        P = J[:, : 3 * int(rows.sum())]
        left = residual[: P.shape[1]] - step @ P
        kept = np.setdiff1d(np.arange(len(P)), gone)
        variance = np.einsum("kr,kr->r", P[kept], C[np.ix_(kept, kept)] @ P[kept])
        return np.sum(left.reshape(3, -1) ** 2, axis=0), variance.reshape(3, -1).sum(axis=0)

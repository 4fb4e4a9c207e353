"""How much each sample, and each row of its equations, counts in a fit."""

from __future__ import annotations

import numpy as np

from modcal_core.calibration.linearise import Linearised
from modcal_core.calibration.noise import Groups, NoiseModel, excess_sigma, robust_noise, robust_weights, standard_score
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.kinds.registry import kinds
from modcal_core.measurements.samples import Samples


def known_sigma(sigma: Array) -> Array:
    """What readings know of their own scatter; zero where they do not, (N,)."""
    return np.where(np.isfinite(sigma), sigma, 0.0)


def weigh(
    at: Linearised,
    pose: np.ndarray,
    known_p: Array,
    known_r: Array,
    groups: Groups,
    parameters: float,
    limit: float | None,
    barred: np.ndarray | None = None,
) -> tuple[Array, NoiseModel]:
    """Robust weights of the samples and the spread left, at these residuals. barred: samples without any weight."""
    square_p, square_r = at.square_position, at.square_rotation
    weights = np.ones(len(square_p))
    if limit is not None:
        rough = robust_noise(at.position, at.rotation, groups)
        total = square_p / (rough.position**2 + known_p**2)
        for kind, of_kind in groups.others.items():
            total[of_kind] = square_p[of_kind] / (rough.others[kind] ** 2 + known_p[of_kind] ** 2)
        if len(square_r):
            total[pose] += square_r / (rough.rotation**2 + known_r**2)
        weights = robust_weights(standard_score(total, groups.dimensions), limit)
        weights = weights if barred is None else np.where(barred, 0.0, weights)
    each = parameters / groups.rows  # degrees of freedom that a row gives up

    def left(rows: np.ndarray | slice, directions: int) -> float:
        seen = square_p[rows]
        return excess_sigma(seen, known_p[rows], weights[rows], each * directions * len(seen), directions)

    noise = NoiseModel(
        left(groups.positions, 3),
        excess_sigma(square_r, known_r, weights[pose], each * 3.0 * len(square_r)),
        {kind: left(rows, kinds()[kind].dimensions) for kind, rows in groups.others.items()},
    )
    return weights, noise


def row_weights(weights: Array, noise: NoiseModel, samples: Samples) -> Array:
    """Weight of each row of a linearisation, (3 N + 3 M,), of samples with these robust weights (N,)."""
    pose = samples.is_pose
    known_p, known_r = known_sigma(samples.sigma_position), known_sigma(samples.sigma_rotation[pose])
    return of_rows(weights, noise.of(samples), noise.rotation, known_p, known_r, pose)


def of_rows(
    weights: Array, noise: Array | float, turning: float, known_p: Array, known_r: Array, pose: np.ndarray
) -> Array:
    """The same of positions of this noise (one, or (N,)) and orientations of that one, beside what readings know."""
    w_p = weights / (noise**2 + known_p**2)
    w_r = weights[pose] / (turning**2 + known_r**2)
    return np.concatenate([w_p, w_p, w_p, w_r, w_r, w_r])

"""What base and tool take up of a difference between two arms, so that what is left is the arms' own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.calibration.linearise import linearise
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.calibration.structure import exact_samples
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.kinds.kind import KIND_NAMES
from modcal_core.measurements.recording import POSE
from modcal_core.measurements.samples import Samples

_SAME = 1e-9  # of the largest singular value; smaller ones are rounding


def twists(T: Array, to: Array) -> Array:
    """Small motions (N, 6) that take poses T (N, 4, 4) to others, as the base sees them: shift at the tool, turn."""
    turn = so3.log(to[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2))
    return np.c_[to[:, :3, 3] - T[:, :3, 3], turn]


def base_and_tool_motions(T: Array, turns: bool) -> Array:
    """What small motions of base and tool do at poses T, (N, 6, 12); of positions alone (N, 3, 12)."""
    out = np.zeros((len(T), 6, 12))
    out[:, :3, :3] = out[:, 3:, 3:6] = np.eye(3)
    out[:, :3, 3:6] = -so3.hat(T[:, :3, 3])  # the base turns about its origin
    out[:, :3, 6:9] = out[:, 3:, 9:12] = T[:, :3, :3]
    return out if turns else out[:, :3]


def poses_at(model: Model, q: Array) -> Samples:
    """Samples of poses at postures q (N, n) in the model's first frame."""
    return exact_samples(model, q, np.zeros(len(q), int), np.full(len(q), POSE, dtype=KIND_NAMES))


def parameter_motions(
    model: Model, parameters: Sequence[ModelParameter], q: Array, effect_values: Array | None = None
) -> Array:
    """What each of K parameters, then effect values, does at the tool at postures q (N, n): ``twists``, (K, N, 6)."""
    values = np.zeros(len(parameters))
    values = values if effect_values is None else np.concatenate([values, effect_values])
    J = linearise(model, tuple(parameters), values, poses_at(model, q)).J
    R = model.chain.T_base_root[:3, :3]
    parts = J.reshape(len(J), 2, 3, -1)
    return np.asarray(np.einsum("ij,kpjn->knpi", R, parts).reshape(len(J), parts.shape[-1], 6))


def without(motions: Array, taken: Array) -> Array:
    """Motions (..., N, 6 or 3) less what base and tool can take up (N, 6 or 3, 12); 1 rad counts as much as 1 m."""
    rows = taken.shape[0] * taken.shape[1]
    flat = motions.reshape(*motions.shape[:-2], rows)
    basis, size, _ = np.linalg.svd(taken.reshape(rows, -1), full_matrices=False)
    kept = basis[:, size > _SAME * size[0]]
    return np.asarray((flat - (flat @ kept) @ kept.T).reshape(motions.shape))

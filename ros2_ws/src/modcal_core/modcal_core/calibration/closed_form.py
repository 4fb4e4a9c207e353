"""Base and tool of readings in closed form, many recordings at a time: ``R ≈ Y A X`` and ``p ≈ Y (A x) + t``.

Y, t: the arm's base in the readings' frame; A: poses of the arm's tip in its base; X, x: the tool. :mod:`conventions`
compares readings as they are with readings corrected by it, :mod:`consistency` finds the stations that agree.
"""

from __future__ import annotations

import numpy as np

from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array

_ALTERNATIONS = 20  # iterations


def base_and_tool_turns(A: Array, R: Array) -> tuple[Array, Array]:
    """(Y, X) with ``R ≈ Y A X`` for rotations A, R (…, N, 3, 3): by SVD (Shah 2013)."""
    # sum of kron(Rᵀ, Aᵀ), which takes y to z
    flat = (np.swapaxes(x.reshape(*x.shape[:-2], 9), -1, -2) for x in (R, A))
    left, right = flat
    products = (left @ np.swapaxes(right, -1, -2)).reshape(*A.shape[:-3], 3, 3, 3, 3)  # R_ji A_lk at j i l k
    U, _, Vt = np.linalg.svd(np.moveaxis(products, (-4, -3, -2, -1), (-2, -4, -1, -3)).reshape(*A.shape[:-3], 9, 9))
    z, y = U[..., 0].reshape(*U.shape[:-2], 3, 3), Vt[..., 0, :].reshape(*U.shape[:-2], 3, 3)
    sign = np.where(np.linalg.det(y) < 0.0, -1.0, 1.0)[..., None, None]
    return so3.nearest_rotation(sign * y), np.swapaxes(so3.nearest_rotation(sign * z), -1, -2)


def turns_left(Y: Array, A: Array, X: Array, R: Array) -> Array:
    """Rotation vectors (…, N, 3) from the predicted to the read orientation, in the tool."""
    return so3.log(np.swapaxes(Y[..., None, :, :] @ A @ X[..., None, :, :], -1, -2) @ R)


def base_by_positions(A: Array, position: Array) -> Array:
    """How bases are turned (C, 3, 3) as positions (C, N, 3) say: base and tool point in turn."""
    x, Y = np.zeros((len(A), 3)), np.empty((len(A), 3, 3))
    still = np.arange(len(A))  # those that still change
    for _ in range(_ALTERNATIONS):
        seen, known = position[still], _points(A[still], x[still])
        seen, known = (z - z.mean(axis=1, keepdims=True) for z in (seen, known))
        Y[still] = so3.nearest_rotation(np.swapaxes(seen, 1, 2) @ known)
        _, new, _ = tool_and_place(Y[still], A[still], position[still])
        step = np.linalg.norm(new - x[still], axis=1)
        x[still] = new
        still = still[step >= 1e-5]
        if not len(still):
            break
    return Y


def _points(A: Array, x: Array) -> Array:
    """Points x (…, 3) moved by poses A (…, N, 4, 4), (…, N, 3)."""
    return np.asarray((A[..., :3, :3] @ x[..., None, :, None])[..., 0] + A[..., :3, 3])


def tool_and_place(Y: Array, A: Array, position: Array) -> tuple[Array, Array, Array]:
    """(residuals (…, N, 3), tool point x (…, 3), base's place t (…, 3)) of ``p ≈ Y (A x) + t``, robust."""
    few, N = A.shape[:-3], A.shape[-3]
    flat = np.empty((*few, N, 3, 6))
    flat[..., :3] = Y[..., None, :, :] @ A[..., :3, :3]
    flat[..., 3:] = np.eye(3)
    flat = flat.reshape(*few, 3 * N, 6)
    h = position - A[..., :3, 3] @ np.swapaxes(Y, -1, -2)
    column = h.reshape(*few, 3 * N, 1)
    weight = np.ones((*few, N))
    for _ in range(3):
        weighted = np.swapaxes(np.repeat(weight, 3, axis=-1)[..., None] * flat, -1, -2)
        H, g = weighted @ flat, weighted @ column
        held = 1e-9 * np.trace(H, axis1=-2, axis2=-1)[..., None, None] * np.eye(6)
        solution = np.linalg.solve(H + held, g)
        gap = h - (flat @ solution).reshape(*few, N, 3)
        square = np.sum(gap**2, axis=-1)
        weight = 1.0 / (square + np.maximum(np.median(square, axis=-1), 1e-18)[..., None])  # Cauchy
        weight = weight / weight.max(axis=-1, keepdims=True)
    return gap, solution[..., :3, 0], solution[..., 3:, 0]

"""Least squares without negative values, of columns that are given by their products."""

from __future__ import annotations

import numpy as np

from modcal_core.geometry import Array

_MAX_STEPS = 100  # of a column; usual are one or two


def nonnegative(A: Array, v: Array) -> Array:
    """The x ≥ 0, (..., n), with the least ``xᵀ A x − 2 vᵀ x``. A: products of the columns (..., n, n), positive
    definite. v: their products with what they are fitted to, (..., n).
    """
    from scipy.optimize import nnls  # slow to import, and of most recordings not asked for

    lower = np.linalg.cholesky(A)
    target = np.linalg.solve(lower, v[..., None])[..., 0]
    x = np.zeros(v.shape)
    for at in np.ndindex(v.shape[:-1]):
        x[at] = nnls(lower[at].T, target[at], maxiter=_MAX_STEPS * v.shape[-1])[0]
    return x

"""Least squares without negative values, of a few columns given by their products (Lawson & Hanson 1974, ch. 23).

What SciPy has for it lies in a package that takes a tenth of a second to load, a twentieth of a small calibration.
Many problems are solved at once, each step of all of them by one call.
"""

from __future__ import annotations

import numpy as np

from modcal_core.geometry.so3 import Array

_ROUNDING = 1e-12  # of the largest slope, below which a value that is zero stays so


def nonnegative(A: Array, v: Array) -> Array:
    """The x ≥ 0, (..., n), with the least ``xᵀ A x − 2 vᵀ x``. A: products of the columns (..., n, n), positive
    definite. v: their products with what they are fitted to, (..., n).
    """
    n = v.shape[-1]
    A, v, shape = A.reshape(-1, n, n), v.reshape(-1, n), v.shape
    x = np.zeros(v.shape)
    free = np.zeros(v.shape, bool)
    least = _ROUNDING * np.abs(v).max(axis=1, initial=0.0)
    rows = np.arange(len(v))
    for _ in range(3 * n):  # usual are a few; rounding must not let it go round for ever
        slope = np.where(free[rows], -np.inf, v[rows] - np.einsum("wij,wj->wi", A[rows], x[rows]))
        steep = slope.max(axis=1) > least[rows]
        rows, slope = rows[steep], slope[steep]
        if not len(rows):
            break
        free[rows, slope.argmax(axis=1)] = True
        _settle(A, v, x, free, rows)
    return x.reshape(shape)


def _settle(A: Array, v: Array, x: Array, free: np.ndarray, rows: np.ndarray) -> None:
    """Bring the free values of some problems to their best, or let go of those that would become negative."""
    while len(rows):
        of = free[rows]
        both = of[:, :, None] & of[:, None, :]
        best = np.linalg.solve(np.where(both, A[rows], np.eye(v.shape[1])), np.where(of, v[rows], 0.0)[..., None])
        best = best[..., 0]
        falling = of & (best <= 0.0)
        fine = ~falling.any(axis=1)
        x[rows[fine]] = best[fine]
        rows, best, falling = rows[~fine], best[~fine], falling[~fine]
        # as far towards the best as all stay positive; those that become zero are no longer free
        now = x[rows]
        share = np.where(falling, now / np.maximum(now - best, 1e-300), np.inf)
        first = share.min(axis=1, keepdims=True, initial=np.inf)
        gone = falling & (share <= first)
        x[rows] = np.where(gone, 0.0, now + np.where(free[rows], first, 0.0) * (best - now))
        free[rows] &= ~gone
        rows = rows[free[rows].any(axis=1)]

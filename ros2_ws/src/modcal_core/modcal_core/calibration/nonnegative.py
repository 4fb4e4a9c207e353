"""Least squares without negative values, of a few columns given by their products (Lawson & Hanson 1974, ch. 23).

What SciPy has for it lies in a package that takes a tenth of a second to load, a twentieth of a small calibration.
"""

from __future__ import annotations

import numpy as np

from modcal_core.geometry.so3 import Array

_ROUNDING = 1e-12  # of the largest slope, below which a value that is zero stays so


def nonnegative(A: Array, v: Array) -> Array:
    """The x ≥ 0, (n,), with the least ``xᵀ A x − 2 vᵀ x``. A: products of the columns (n, n), positive definite. v:
    their products with what they are fitted to, (n,).
    """
    x = np.zeros(len(v))
    free = np.zeros(len(v), bool)
    least = _ROUNDING * float(np.abs(v).max(initial=0.0))
    for _ in range(3 * len(v)):  # usual are a few; rounding must not let it go round for ever
        slope = np.where(free, -np.inf, v - A @ x)
        if not slope.max(initial=-np.inf) > least:
            break
        free[int(np.argmax(slope))] = True
        while True:
            rows = np.flatnonzero(free)
            best = np.linalg.solve(A[np.ix_(rows, rows)], v[rows])
            if best.min() > 0.0:
                x[:] = 0.0
                x[rows] = best
                break
            # as far towards the best as all stay positive; those that become zero are no longer free
            falling = best <= 0.0
            share = x[rows][falling] / np.maximum(x[rows][falling] - best[falling], 1e-300)
            x[rows] += share.min() * (best - x[rows])
            gone = rows[falling][share <= share.min()]
            x[gone], free[gone] = 0.0, False
            if not free.any():
                break
    return x

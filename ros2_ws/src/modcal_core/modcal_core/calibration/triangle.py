"""The inverse of a triangle: what a covariance is made of, where a factor is known.

LAPACK's own goes row by row within blocks of its choice, and takes two to three times as long at some hundred rows.
"""

from __future__ import annotations

import numpy as np
import scipy

from modcal_core.geometry.so3 import Array

_BLOCK = 64  # rows; between 32 and 128 it makes no difference


def inverse_of_triangle(lower: Array) -> Array:
    """The inverse of a lower triangle (P, P), zeros above its diagonal. What lower has there is not read.

    Block rows of ``L⁻¹`` from the first to the last, each by products with those before it (Golub & Van Loan 2013,
    section 3.1).
    """
    P = len(lower)
    out = np.zeros((P, P), order="F")
    for first in range(0, P, _BLOCK):
        rows = slice(first, min(first + _BLOCK, P))
        own = np.tril(scipy.linalg.lapack.dtrtri(lower[rows, rows], lower=1)[0])
        out[rows, rows] = own
        if first:
            out[rows, :first] = -(own @ (lower[rows, :first] @ out[:first, :first]))
    return out

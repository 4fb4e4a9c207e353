"""What candidates of a few columns each explain: ``nᵀ G⁻¹ n`` with n their products with a residual, G with each other.

Thousands are asked at once, nearly all of one, two or four columns.
"""

from __future__ import annotations

import numpy as np

from modcal_core.geometry.so3 import Array

_ONLY_ROUNDING = 1e-13  # added to what is inverted, so that it can be
_MIN_NEW = 0.0025  # share of a candidate's square (5 % of its size) that the fit cannot make by itself


def inverses(gram: Array, own: Array) -> tuple[Array, np.ndarray]:
    """Inverses (C, m, m) of products of columns with each other, and how many directions are new, (C,).

    own: squares of the columns (C, m). Directions that the fit can nearly make by itself are left out.
    """
    scale = 1.0 / np.sqrt(np.maximum(own, 1e-300))
    scaled = gram * scale[:, :, None] * scale[:, None, :]
    # Where all directions are new, which is most often, there is nothing to take apart: the least eigenvalue is no less
    # than one over the size of the inverse.
    m = scaled.shape[1]
    if m == 2:
        a, b, d = scaled[:, 0, 0], scaled[:, 0, 1], scaled[:, 1, 1]
        out = np.array([[d, -b], [-b, a]]).transpose(2, 0, 1) / np.maximum(a * d - b * b, 1e-300)[:, None, None]
        rest = np.flatnonzero(0.5 * (a + d) - np.hypot(0.5 * (a - d), b) <= _MIN_NEW)
    else:
        out = np.asarray(np.linalg.inv(scaled + _ONLY_ROUNDING * np.eye(m)), dtype=float)
        rest = np.flatnonzero(~(np.einsum("cij,cij->c", out, out) < _MIN_NEW**-2))
    sizes = np.full(len(scaled), m)
    value, vector = np.linalg.eigh(scaled[rest])
    keep = value > _MIN_NEW
    part = np.where(keep, 1.0 / np.maximum(value, _MIN_NEW), 0.0)[:, None]
    out[rest], sizes[rest] = (vector * part) @ vector.transpose(0, 2, 1), keep.sum(axis=1)
    return out * scale[:, :, None] * scale[:, None, :], sizes


def explained(inverse: Array, n: Array) -> Array:
    """``nᵀ inverse n`` of each candidate and trial, (C, trials): inverse (C, m, m), n (C, m, trials)."""
    if n.shape[1] == 1:
        return np.asarray(n[:, 0] ** 2 * inverse[:, 0])
    if n.shape[1] == 2:  # nine in ten: without a product of small matrices for each of them
        out = n[:, 0] * inverse[:, 0, :1]
        out += n[:, 1] * (2.0 * inverse[:, 0, 1:])
        out *= n[:, 0]
        out += n[:, 1] ** 2 * inverse[:, 1, 1:]
        return np.asarray(out)
    return np.asarray(np.einsum("cmf,cmf->cf", inverse @ n, n))

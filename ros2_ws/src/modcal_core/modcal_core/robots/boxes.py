"""The largest box around nothing at all that keeps to linear limits: per-joint bounds that hold for all joints at once.

Wanted are bounds −l ≤ x ≤ u with l, u > 0, of the greatest product Π (u_i l_i)^w_i, such that every x between them
obeys ``lower ≤ A x ≤ upper``. Which weights w_i > 0 is a matter of taste, and 1 the plain choice; whichever, the box
does not depend on the units of the components. A box obeys a row
if its worst corner does, which is linear in (u, l): with A⁺ and A⁻ the positive and negative parts of A,

    | A⁺  A⁻ | | u |     |  upper |
    | A⁻  A⁺ | | l |  ≤  | −lower |

so a concave function, Σ w log z, is maximised over a polytope, B z ≤ h with B ≥ 0, z > 0. With multipliers y of the
rows the optimum is where Bᵀ y = w/z and y (h − B z) = 0; Newton's method on both, the second relaxed to μ → 0 (a
primal-dual interior point; Boyd and Vandenberghe, Convex Optimization, 2004, chapter 11).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg.lapack import dposv

from modcal_core.geometry.so3 import Array

_MAX_STEPS = 60
_GAP = 1e-7  # of Σ w log z, to the best there is: bounds within some 1e-5 of the best ones, and never outside
_TO_THE_WALL = 0.99  # of the way to where something would turn negative
_CENTRING = 0.1


def largest_box(
    A: ArrayLike, lower: ArrayLike, upper: ArrayLike, weights: ArrayLike | None = None
) -> tuple[Array, Array]:
    """Lower and upper bounds (N, n), lower < 0 < upper, of the largest boxes in N polytopes lower ≤ A x ≤ upper.

    A: (N, m, n), no column without a number. lower < 0 < upper: (N, m). weights: (n,) > 0; all 1 if none are given.
    """
    A = np.asarray(A, dtype=float)
    n = A.shape[-1]
    up, down = np.maximum(A, 0.0), np.maximum(-A, 0.0)
    B = np.concatenate([np.concatenate([up, down], axis=-1), np.concatenate([down, up], axis=-1)], axis=-2)
    h = np.concatenate([np.asarray(upper, dtype=float), -np.asarray(lower, dtype=float)], axis=-1)
    assert (h > 0.0).all()
    assert (B.max(axis=-2) > 0.0).all()
    # in units in which each bound alone would be 1 and every limit is 1
    B = B / h[..., None]
    alone = 1.0 / B.max(axis=-2)
    w = np.ones(n) if weights is None else np.asarray(weights, dtype=float)
    assert (w > 0.0).all()
    largest = _largest_of_one if len(B) == 1 else _largest
    z = largest(B * alone[..., None, :], np.tile(w / w.mean(), 2)) * alone
    z /= (B @ z[..., None]).max(axis=(-2, -1))[..., None]  # rounding must not leave it outside
    return -z[..., n:], z[..., :n]


def _largest(B: Array, w: Array) -> Array:
    """z (N, k) of the greatest Σ w log z with B z ≤ 1, for B (N, m, k) whose columns reach 1."""
    N, m, k = B.shape
    z = np.full((N, k), 0.5) / B.sum(axis=-1).max(axis=-1)[:, None]
    s = 1.0 - (B @ z[..., None])[..., 0]
    y = np.full((N, m), 1.0 / m) / s
    weights, sides = np.diag(w), np.empty((N, m, 2))
    for _ in range(_MAX_STEPS):
        gap = (y * s).sum(axis=-1, keepdims=True)
        aim = (_CENTRING / m) * gap / s  # where y would be, were all y s alike and smaller
        scaled = B * z[:, None, :]  # by which z changes relatively: well conditioned whatever the bounds' sizes
        scaled_t = scaled.swapaxes(-1, -2)
        sides[..., 0], sides[..., 1] = y, aim
        missing = w[:, None] - scaled_t @ sides  # (N, k, 2): with y as it is, and there
        open_ = (gap > _GAP) | (np.abs(missing[..., 0]).max(axis=-1, keepdims=True) > _GAP)
        if not open_.any():
            break
        slope = y / s
        d = np.linalg.solve(weights + scaled_t @ (scaled * slope[..., None]), missing[..., 1:])
        ds = -(scaled @ d)[..., 0]
        dy = aim - y - slope * ds
        d = d[..., 0]
        step = np.where(open_, np.minimum(_reach(d), _reach(ds / s)), 0.0)
        z, s = z * (1.0 + step * d), s + step * ds
        y = y + np.where(open_, _reach(dy / y), 0.0) * dy
    return z


def _largest_of_one(B: Array, w: Array) -> Array:
    """The same of one, B (1, m, k), step by step: what a node asks for many times a second, in half the time."""
    B = B[0]
    m, k = B.shape
    z = np.full(k, 0.5 / float(B.sum(axis=1).max()))
    s = 1.0 - B @ z
    y = (1.0 / m) / s
    for _ in range(_MAX_STEPS):
        gap = float(y @ s)
        scaled = B * z
        missing = w - y @ scaled
        if gap <= _GAP and float(np.abs(missing).max()) <= _GAP:
            break
        inverse = 1.0 / s
        aim, slope = (_CENTRING * gap / m) * inverse, y * inverse
        matrix = scaled.T @ (scaled * slope[:, None])
        matrix.flat[:: k + 1] += w
        d = dposv(matrix, w - aim @ scaled, overwrite_a=1)[1]
        ds = -(scaled @ d)
        dy = aim - y - slope * ds
        step = min(_reach_of_one(d), _reach_of_one(ds * inverse))
        z, s = z * (1.0 + step * d), s + step * ds
        y = y + _reach_of_one(dy / y) * dy
    return z[None]


def _reach_of_one(change: Array) -> float:
    worst = -float(change.min())
    return _TO_THE_WALL / worst if worst > _TO_THE_WALL else 1.0


def _reach(change: Array) -> Array:
    """How much of a relative change (N, k) leaves positive values positive, (N, 1), at most 1."""
    worst = -change.min(axis=-1, keepdims=True)
    return np.minimum(1.0, _TO_THE_WALL / np.maximum(worst, 1e-300))

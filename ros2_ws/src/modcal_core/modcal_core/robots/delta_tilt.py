"""A Delta whose parallelograms have two unequal rods: the platform turns, as the closed chain of six rods does.

Each pair keeps its own line of the platform parallel to its elbow's but for what its rods differ by,

    s_i · (R t_i − t_i) = ε_i,

three equations for the platform's orientation R; the middle p follows from three spheres about the elbows, shifted by
``(R − 1) r u_i`` (:mod:`delta` has the symbols). With a_i = R t_i × s_i and w_i the columns of the inverse of the
matrix with these rows, the platform turns by ``Σ w_i ε_i`` to first order. This is what of the closed chain with 54
parameters (Vischer and Clavel 1998) remains once each pair's mean is one rod: constant tilts of axes and shifts of
joints along the rods are errors of the arms' places.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array, cross
from modcal_core.robots.kinematics import Tilt

_ROUNDS, _DONE = 12, 1e-13  # iterations, each ten times nearer and more; rad


def tilted(
    difference: Array, lean: Array, radius: float, axes: Array, place: Callable[[Array], tuple[Array, Array]]
) -> tuple[Array, Array, Array]:
    """(turn R (N, 3, 3), middle (3, N), rods' directions (3 arms, 3, N)) of the platform, in the base.

    difference: ε (3, N). lean: ε times what the platform's radius is more than radius [m], (3, N). axes: x outwards and
    z along the tangent of each arm, (3 arms, 3 axes, 3, N). place: middle and directions for shifts (3 arms, 3, N).
    """
    N = difference.shape[1]
    square = np.sum(difference**2, axis=0)
    r = radius + np.where(square > 0.0, np.sum(lean * difference, axis=0) / np.where(square > 0.0, square, 1.0), 0.0)
    out, tangent = axes[:, 0], axes[:, 2]
    R = np.tile(np.eye(3), (N, 1, 1))
    for _ in range(_ROUNDS):
        middle, along = place(r * (_turned(R, out) - out))
        now = _turned(R, tangent)
        missing = difference - np.sum(along * (now - tangent), axis=1)
        turn = np.einsum("icn,in->cn", inverse_rows(np.stack([cross(now[i], along[i]) for i in range(3)])), missing)
        R = so3.exp(turn.T) @ R
        if not np.nanmax(np.abs(turn), initial=0.0) > _DONE:
            break
    middle, along = place(r * (_turned(R, out) - out))
    return R, middle, along


def _turned(R: Array, v: Array) -> Array:
    """Vectors (3 arms, 3, N) turned by R (N, 3, 3)."""
    return np.asarray(np.einsum("nij,ajn->ain", R, v))


def inverse_rows(a: Array) -> Array:
    """Columns (3, 3, N), column i at index i, of the inverse of a matrix with rows a (3, 3, N)."""
    columns = np.stack([cross(a[1], a[2]), cross(a[2], a[0]), cross(a[0], a[1])])
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(columns / np.sum(a[0] * columns[0], axis=0))


def tilts(axes: Array, along: Array, gains: Array, middle: Array, radius: float) -> tuple[Tilt, Tilt, Tilt]:
    """How the platform turns and its middle shifts per ε of each arm.

    axes: as of :func:`tilted`, those of the platform. along, gains: of the rods (3 arms, 3, N).
    """
    turns = inverse_rows(np.stack([cross(axes[i, 2], along[i]) for i in range(3)]))
    found = []
    for turn in turns:
        lean = -sum(gains[j] * np.sum(along[j] * cross(turn, axes[j, 0]), axis=0) for j in range(3))
        found.append(Tilt(turn, radius * lean, np.asarray(lean), middle))
    return found[0], found[1], found[2]

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
from dataclasses import dataclass

import numpy as np

from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array, cross
from modcal_core.robots.kinematics import LoopShare, Tilt

_ROUNDS, _DONE = 12, 1e-13  # iterations, each ten times nearer and more; rad


@dataclass(frozen=True)
class Stand:
    """How a platform stands. R: its turn, (N, 3, 3). middle: (3, N) [m]. along: of the rods, (3 arms, 3, N). radius:
    of the platform, (N,) [m]. out, tangent: of the arms, (3 arms, 3, N), as a level platform has them. share: of each
    arm in a length that comes with ε of all, (3 arms, N). lengths: what the radius is more than the known one, and the
    middle in the level tip, (4, N) [m].
    """

    R: Array
    middle: Array
    along: Array
    radius: Array
    out: Array
    tangent: Array
    share: Array
    lengths: Array


def tilted(unequal: Array, known: float, axes: Array, place: Callable[[Array], tuple[Array, Array]]) -> Stand:
    """How a platform stands whose rods differ.

    unequal: ε, and ε times the four lengths of :class:`Stand`, (5, 3 arms, N). known: the radius [m]. axes: x outwards
    and z along the tangent of each arm, (3 arms, 3 axes, 3, N). place: middle and rods' directions for shifts
    (3 arms, 3, N) of the elbows.
    """
    difference, N = unequal[0], unequal.shape[2]
    square = np.sum(difference**2, axis=0)
    share = np.where(square > 0.0, difference / np.where(square > 0.0, square, 1.0), 0.0)
    lengths = np.einsum("lan,an->ln", unequal[1:], share)
    radius, out, tangent = known + lengths[0], axes[:, 0], axes[:, 2]
    R = np.tile(np.eye(3), (N, 1, 1))
    for _ in range(_ROUNDS):
        middle, along = place(radius * (turned(R, out) - out))
        now = turned(R, tangent)
        missing = difference - np.sum(along * (now - tangent), axis=1)
        turn = np.einsum("icn,in->cn", inverse_rows(np.stack([cross(now[i], along[i]) for i in range(3)])), missing)
        R = so3.exp(turn.T) @ R
        if not np.nanmax(np.abs(turn), initial=0.0) > _DONE:
            break
    middle, along = place(radius * (turned(R, out) - out))
    return Stand(R, middle, along, radius, out, tangent, share, lengths)


def turned(R: Array, v: Array) -> Array:
    """Vectors (3 arms, 3, N) turned by R (N, 3, 3)."""
    return np.asarray(np.einsum("nij,ajn->ain", R, v))


def inverse_rows(a: Array) -> Array:
    """Columns (3, 3, N), column i at index i, of the inverse of a matrix with rows a (3, 3, N)."""
    columns = np.stack([cross(a[1], a[2]), cross(a[2], a[0]), cross(a[0], a[1])])
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(columns / np.sum(a[0] * columns[0], axis=0))


def level_tilts(axes: Array, along: Array, gains: Array, middle: Array, radius: float, base: Array) -> list[Tilt]:
    """How a level platform turns and its middle shifts per ε of each arm.

    axes: as of :func:`tilted`. along, gains: of the rods (3 arms, 3, N). base: its axes, (3, 3, N).
    """
    turns = inverse_rows(np.stack([cross(axes[i, 2], along[i]) for i in range(3)]))
    found = []
    for turn in turns:
        lean = -np.sum([gains[j] * np.sum(along[j] * cross(turn, axes[j, 0]), axis=0) for j in range(3)], axis=0)
        none = np.zeros_like(turn)
        more = ((none, lean), *((none, cross(turn, base[c])) for c in range(3)))
        found.append(Tilt(turn, radius * lean, more, middle))
    return found


def tilted_shares(
    stand: Stand, distal: Array, rates: Array, ends: Array, base: Array, azimuth: int
) -> list[tuple[Tilt, tuple[LoopShare, LoopShare]]]:
    """For each arm how the platform moves with its rods' difference, and with a motion of its elbow.

    The platform's twist (δp, δw) solves two equations for each arm, the length of its mean rod and what its rods differ
    by. distal: lengths (3,). rates: along the rods per unit of each constant, (3 arms, constants, N). ends: what an
    elbow moves by per unit of each, (3 arms, constants, 3, N). base: its axes, (3, 3, N). azimuth: the
    number of that constant.
    """
    N = stand.middle.shape[1]
    now_out, now_tangent = turned(stand.R, stand.out), turned(stand.R, stand.tangent)
    apart, leant = now_tangent - stand.tangent, now_out - stand.out
    s = stand.along
    g = (apart - s * np.sum(s * apart, axis=1, keepdims=True)) / distal[:, None, None]
    A = np.empty((N, 6, 6))
    for i in range(3):
        arm = stand.radius * now_out[i]
        A[:, i, :3], A[:, i, 3:] = s[i].T, cross(arm, s[i]).T
        A[:, 3 + i, :3], A[:, 3 + i, 3:] = g[i].T, (cross(arm, g[i]) + cross(now_tangent[i], s[i])).T
    known = np.isfinite(A).all(axis=(1, 2))
    X = np.full((N, 6, 6), np.nan)
    X[known] = np.linalg.inv(A[known])
    by = np.moveaxis(X, (1, 2), (1, 0))  # equation, component, N
    by_radius = -np.sum([by[i] * np.sum(s[i] * leant[i], axis=0) for i in range(3)], axis=0)
    by_radius = by_radius - np.sum([by[3 + i] * np.sum(g[i] * leant[i], axis=0) for i in range(3)], axis=0)
    up, none = base[2], np.zeros((3, N))
    lever = np.einsum("cn,cdn->dn", stand.lengths[1:], base)
    swings = turned(stand.R, base) - base  # what a length along each axis shifts the tool by
    swing = np.einsum("cn,cdn->dn", stand.lengths[1:], swings)
    found = []
    for i in range(3):
        lean = stand.share[i] * by_radius
        own = by[3 + i] - stand.lengths[0] * lean
        more = ((lean[3:], lean[:3]), *((none, stand.share[i] * swings[c]) for c in range(3)))
        # lengths come with ε of all arms: one arm's ε alone takes its share of them back
        tilt = Tilt(own[3:], own[:3] - stand.share[i] * swing, more, stand.middle - lever)
        first, second = rates[i].copy(), np.einsum("cn,kcn->kn", g[i], ends[i])
        # an arm's azimuth turns its tangent and its way out as well
        swung = stand.radius * (turned(stand.R, cross(up, stand.out[i])[None])[0] - cross(up, stand.out[i]))
        skewed = turned(stand.R, cross(up, stand.tangent[i])[None])[0] - cross(up, stand.tangent[i])
        first[azimuth] -= np.sum(s[i] * swung, axis=0)
        second[azimuth] -= np.sum(g[i] * swung, axis=0) + np.sum(s[i] * skewed, axis=0)
        shares = LoopShare(s[i], by[i, :3], by[i, 3:], first), LoopShare(g[i], by[3 + i, :3], by[3 + i, 3:], second)
        found.append((tilt, shares))
    return found

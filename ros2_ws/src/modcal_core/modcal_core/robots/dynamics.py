"""The torques that a motion takes: M(q) q̈ + C(q, q̇) q̇ + g(q), without friction.

Newton and Euler's recursion, written in the base frame, where it becomes sums along the chain. With S_i the unit twist
of joint i and I_j the spatial inertias of :mod:`modcal_core.robots.inertia`, at q̈ = 0:

    V_j = Σ_{i ≤ j} S_i q̇_i,    A_j = (−g, 0) + Σ_{i ≤ j} ad(V_i) S_i q̇_i,
    F_j = I_j A_j − ad(V_j)ᵀ I_j V_j,    τ_i = S_iᵀ Σ_{j ≥ i} F_j.

Gravity is an acceleration of the base upwards (Luh, Walker and Paul 1980; Featherstone 2008, chapter 5).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.gravity import STANDARD_GRAVITY
from modcal_core.robots.inertia import Bodies, beyond
from modcal_core.robots.urdf_inertias import Inertias

DOWN = (0.0, 0.0, -STANDARD_GRAVITY)


def bias_torque(
    chain: Chain, inertias: Inertias, q: ArrayLike, velocity: ArrayLike, gravity: ArrayLike = DOWN
) -> Array:
    """Drive torques C(q, q̇) q̇ + g(q) (N, n) [N m; N] that go with no joint acceleration.

    q, velocity: (N, n) [rad, m; rad/s, m/s]. gravity: acceleration of free fall (3,) [m/s²] in the base.
    """
    return bias_of(Bodies.at(chain, inertias, q), velocity, gravity)


def bias_of(bodies: Bodies, velocity: ArrayLike, gravity: ArrayLike = DOWN) -> Array:
    """:func:`bias_torque` of bodies at their postures."""
    rate = np.swapaxes(bodies.twists, 1, 2) * np.asarray(velocity, dtype=float)[..., None]  # S_i q̇_i, (N, n, 6)
    V = np.cumsum(rate, axis=1)
    ad = _bracket(V)
    A = np.cumsum((ad @ rate[..., None])[..., 0], axis=1)
    A[..., :3] -= np.asarray(gravity, dtype=float)
    inertia = bodies.spatial
    force = inertia @ A[..., None] - np.swapaxes(ad, -1, -2) @ (inertia @ V[..., None])
    return np.einsum("nai,nia->ni", bodies.twists, beyond(force[..., 0]))


def torque(
    chain: Chain,
    inertias: Inertias,
    q: ArrayLike,
    velocity: ArrayLike,
    acceleration: ArrayLike,
    gravity: ArrayLike = DOWN,
) -> Array:
    """Drive torques (N, n) [N m; N] of a motion without friction: M q̈ + C q̇ + g. All arguments (N, n)."""
    bodies = Bodies.at(chain, inertias, q)
    inertial = np.einsum("nij,nj->ni", bodies.matrix, np.asarray(acceleration, dtype=float))
    return inertial + bias_of(bodies, velocity, gravity)


def _bracket(V: Array) -> Array:
    """ad(V) of twists (..., 6) as matrices (..., 6, 6): ad(V) X is the change of X as its frame moves with V."""
    turn, shift = so3.hat(V[..., 3:]), so3.hat(V[..., :3])
    out = np.zeros((*V.shape, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = turn
    out[..., :3, 3:] = shift
    return out

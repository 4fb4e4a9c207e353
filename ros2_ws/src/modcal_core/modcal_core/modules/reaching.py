"""Inverse kinematics of many arms at once: postures that bring each arm's tool to one target.

Newton's method on the rows of the target (see :mod:`modcal_core.modules.targets`), damped after Levenberg and
Marquardt, for every arm from every start at the same time:

    (JᵀJ + μ I) δq = −Jᵀ r,    with J from the axes z_k through p_k:  dR e_c = z_k × R e_c,  dp = z_k × (p − p_k).

A step that makes things worse is taken back and μ raised; one that helps lowers it, so the end is quadratic. A joint
that would leave its limits is held there. Numbers stand with their components first and the arms last, one long
contiguous axis; a thousand descents cost little more than the overhead of one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.geometry import Array
from modcal_core.modules.catalogue import Arms
from modcal_core.modules.targets import Target

CONVERGED = 1e-9  # of the root sum of squares of the rows
_FAR = 1e-3
_LONGEST = 1.0  # rad or m, of one joint in one step
_FREE_TURN = np.pi  # rad; how far a joint without limits is started from zero
_FREE_SLIDE = 0.5  # m


@dataclass(frozen=True)
class Reached:
    """Where descents ended. q: (N, S, n) [rad, m], within the limits; left: root sum of squares of the rows, (N, S)."""

    q: Array
    left: Array


def starts(arms: Arms, unit: Array) -> Array:
    """Postures (N, S, n) within the limits of the arms, from points of the unit cube (S, n)."""
    span = np.where(arms.revolute, _FREE_TURN, _FREE_SLIDE)
    low = np.where(np.isfinite(arms.lower), arms.lower, -span)
    high = np.where(np.isfinite(arms.upper), arms.upper, span)
    out: Array = low[:, None] + unit * (high - low)[:, None]
    return out


def reach(arms: Arms, target: Target, q: Array, steps: int) -> Reached:
    """Ends of descents from postures q (N, S, n), after a limited number of steps."""
    count, each, n = q.shape
    which = np.repeat(np.arange(count), each)
    fleet = _Fleet.of(arms, which)
    q_end = np.ascontiguousarray(q.reshape(-1, n).T)
    left = np.full(q_end.shape[1], np.inf)
    active = np.arange(q_end.shape[1])
    q_now = np.clip(q_end, fleet.lower, fleet.upper)
    r, J = _rows(fleet, target, q_now)
    cost = np.einsum("rn,rn->n", r, r)
    mu = 1e-2 * np.ones_like(cost)
    q_end[:], left[:] = q_now, np.sqrt(cost)
    going = cost > CONVERGED**2
    for _ in range(steps):
        new = _step(fleet, q_now, r, J, mu)
        r_new, J_new = _rows(fleet, target, new)
        cost_new = np.einsum("rn,rn->n", r_new, r_new)
        better = (cost_new < cost) & going
        mu = np.where(better, np.maximum(0.15 * mu, 1e-13), np.minimum(6.0 * mu, 1e6))
        q_now = np.where(better, new, q_now)
        r, J = np.where(better, r_new, r), np.where(better, J_new, J)
        cost_old, cost = cost, np.where(better, cost_new, cost)
        # an accepted step that gains next to nothing, far from the target: a dead end
        dead = better & (cost_new > 0.99 * cost_old) & (cost > _FAR**2)
        going &= (cost > CONVERGED**2) & (mu < 1e4) & ~dead
        if going.mean() < 0.7:  # what has come to an end stays as it is, and is put aside now and then
            q_end[:, active], left[active] = q_now, np.sqrt(cost)
            if not going.any():
                break
            active, fleet = active[going], fleet.take(going)
            q_now, r, J, cost, mu = (np.compress(going, x, axis=-1) for x in (q_now, r, J, cost, mu))
            going = np.ones(len(active), bool)
    else:
        q_end[:, active], left[active] = q_now, np.sqrt(cost)
    return Reached(q_end.T.reshape(count, each, n), left.reshape(count, each))


@dataclass(frozen=True)
class _Fleet:
    """The arms again, components first: rotations and positions of M_k, (n + 1, 3, 3, N), (n + 1, 3, N)."""

    R: Array
    p: Array
    revolute: np.ndarray
    slides: bool
    lower: Array
    upper: Array

    @classmethod
    def of(cls, arms: Arms, which: np.ndarray) -> _Fleet:
        M = np.ascontiguousarray(np.moveaxis(arms.origins, 0, -1)[..., which])
        rest = (np.ascontiguousarray(a.T[:, which]) for a in (arms.revolute, arms.lower, arms.upper))
        revolute, lower, upper = rest
        return cls(M[:, :3, :3], M[:, :3, 3], revolute, not bool(revolute.all()), lower, upper)

    def take(self, which: np.ndarray) -> _Fleet:
        parts = (np.compress(which, x, axis=-1) for x in (self.R, self.p, self.revolute))
        R, p, revolute = parts
        lower, upper = (np.compress(which, x, axis=-1) for x in (self.lower, self.upper))
        return _Fleet(R, p, revolute, not bool(revolute.all()), lower, upper)


def _rows(fleet: _Fleet, target: Target, q: Array) -> tuple[Array, Array]:
    """The rows (r, N) at postures q (n, N), and their derivatives (n, r, N)."""
    n, count = q.shape
    R, p = fleet.R[0], fleet.p[0]
    axes, places = np.empty((n, 3, count)), np.empty((n, 3, count))
    angle = np.where(fleet.revolute, q, 0.0) if fleet.slides else q
    c, s = np.cos(angle), np.sin(angle)
    for k in range(n):
        axes[k], places[k] = R[:, 2], p
        turned = np.empty_like(R)
        turned[:, 0] = c[k] * R[:, 0] + s[k] * R[:, 1]
        turned[:, 1] = c[k] * R[:, 1] - s[k] * R[:, 0]
        turned[:, 2] = R[:, 2]
        if fleet.slides:
            p = p + (q[k] - angle[k]) * R[:, 2]
        M, m = fleet.R[k + 1], fleet.p[k + 1]
        p = p + turned[:, 0] * m[0] + turned[:, 1] * m[1] + turned[:, 2] * m[2]
        R = turned[:, :1] * M[0] + turned[:, 1:2] * M[1] + turned[:, 2:] * M[2]
    A, b = target.rows
    used = np.flatnonzero(A.any(axis=0).reshape(3, 4).any(axis=0))  # columns of the pose that count
    A = A.reshape(-1, 3, 4)[:, :, used].reshape(len(A), -1)
    x = np.empty((3, len(used), count))
    for i, column in enumerate(used):
        x[:, i] = p if column == 3 else R[:, column]
    r = A @ x.reshape(-1, count) - b[:, None]
    J = np.empty((n, len(A), count))
    for k in range(n):
        dx = np.empty_like(x)
        for i, column in enumerate(used):
            arm = p - places[k] if column == 3 else R[:, column]
            _cross(axes[k], arm, dx[:, i])
            if fleet.slides:
                dx[:, i] = np.where(fleet.revolute[k], dx[:, i], axes[k] if column == 3 else 0.0)
        J[k] = A @ dx.reshape(-1, count)
    return r, J


def _cross(a: Array, b: Array, out: Array) -> None:
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


def _step(fleet: _Fleet, q: Array, r: Array, J: Array, mu: Array) -> Array:
    """The next postures (n, N): damped, no longer than allowed, within the limits."""
    g = np.einsum("krn,rn->kn", J, r)
    held = ((q <= fleet.lower) & (g > 0.0)) | ((q >= fleet.upper) & (g < 0.0))
    if held.any():
        J = np.where(held[:, None], 0.0, J)
        g = np.where(held, 0.0, g)
    H = np.einsum("irn,jrn->ijn", J, J)
    for k in range(len(q)):
        H[k, k] += mu
    step = -_solve(H, g)
    step *= np.minimum(1.0, _LONGEST / np.maximum(np.abs(step).max(axis=0), 1e-300))
    return np.clip(q + step, fleet.lower, fleet.upper)


def _solve(H: Array, g: Array) -> Array:
    """Solutions (n, N) of positive definite systems (n, n, N), by L D Lᵀ; H is overwritten.

    For n ≤ 7 and thousands of systems ten times as fast as a call for each.
    """
    n = len(g)
    for k in range(n):
        for i in range(k + 1, n):
            f = H[i, k] / H[k, k]
            for j in range(i, n):
                H[j, i] -= f * H[j, k]
            H[k, i] = f  # L, kept above the diagonal
    y = g.copy()
    for k in range(n):
        for i in range(k + 1, n):
            y[i] -= H[k, i] * y[k]
    for k in range(n - 1, -1, -1):
        y[k] /= H[k, k]
        for i in range(k + 1, n):
            y[k] -= H[k, i] * y[i]
    return y

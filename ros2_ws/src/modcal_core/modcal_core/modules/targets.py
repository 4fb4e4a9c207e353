"""Tool poses that an arm must reach, and the search for postures that do.

A mask of six says what must be met, turns first as the source has it: about x, y, z, then along x, y, z, seen from the
tool as it is wanted. 110111 leaves the tool's turn about its own z free.

The source measures a turn by e = ½ (n × n' + o × o' + a × a'), which is zero at half a turn too, and does not lead
there. What leads there are *rows*, linear in the twelve numbers of the pose, zero where the mask is met and nowhere
else:

    one axis c free     R e_c − R' e_c                    the axis itself must agree; 3 rows
    none free           R − R', all three axes            9 rows, by √½ to weigh as much
    two free            the one component of e that is left; 1 row
    position            the unmasked components of R'ᵀ (p − p')

Postures are found by Newton's method on these rows, damped after Levenberg and Marquardt, for every arm from every
start at the same time, a joint being held at its limits:

    (JᵀJ + μ I) δq = −Jᵀ r,    with J from the axes z_k through p_k:  dR e_c = z_k × R e_c,  dp = z_k × (p − p_k).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.geometry import Array, cross, se3, sealed, so3
from modcal_core.modules.library import Assembly, Library, origins
from modcal_core.robots import ranges


@dataclass(frozen=True)
class Target:
    """A wanted pose of the tool. T: (4, 4) [m] in the base; mask: (6,) of bool, turns first; name: for people."""

    T: Array
    mask: np.ndarray
    name: str = ""

    @classmethod
    def build(cls, R: ArrayLike, p: ArrayLike, mask: ArrayLike = (1, 1, 1, 1, 1, 1), name: str = "") -> Target:
        """A target of a rotation (3, 3) that may be rounded: made orthonormal, a lone axis that counts first."""
        kept = np.array(mask, dtype=bool)
        return sealed(cls(se3.transform(_orthonormal(np.asarray(R, dtype=float), kept[:3]), p), kept, name))

    @property
    def constraints(self) -> int:
        """Σm: of how many numbers the mask asks."""
        return int(self.mask.sum())

    @cached_property
    def rows(self) -> tuple[Array, Array]:
        """A (r, 12) and b (r,) of the rows ``A x − b``, x the 3 × 4 upper part of a pose, row by row."""
        R, p = self.T[:3, :3], self.T[:3, 3]
        unit = np.eye(12).reshape(3, 4, 12)  # of every entry of the pose
        free, out = np.flatnonzero(~self.mask[:3]), list[Array]()
        if len(free) == 0:
            out += [*np.sqrt(0.5) * unit[:, :3].swapaxes(0, 1).reshape(9, 12)]
        elif len(free) == 1:
            out += [*unit[:, free[0]]]
        elif len(free) == 2:
            a = int(np.flatnonzero(self.mask[:3])[0])
            j, k = (a + 1) % 3, (a + 2) % 3
            # of R'ᵀ R the entry (k, j), the sine of a turn about a, against (j, k)
            out.append(0.5 * (R[:, k] @ unit[:, j] - R[:, j] @ unit[:, k]))
        out += [R[:, i] @ unit[:, 3] for i in np.flatnonzero(self.mask[3:])]
        A = np.stack(out) if out else np.zeros((0, 12))
        wanted = np.concatenate([R, p[:, None]], axis=1).ravel()
        return A, A @ wanted

    def error(self, T: ArrayLike) -> Array:
        """The published measure e·m (..., 6) of poses (..., 4, 4): turn, then way [m], in the frame of the target."""
        T = np.asarray(T, dtype=float)
        R = self.T[:3, :3]
        turn = 0.5 * np.cross(T[..., :3, :3], R, axisa=-2, axisb=-2, axisc=-2).sum(axis=-1)
        e = np.concatenate([turn @ R, (self.T[:3, 3] - T[..., :3, 3]) @ R], axis=-1)
        return e * self.mask

    def miss(self, T: ArrayLike) -> tuple[Array, Array]:
        """How far poses (..., 4, 4) miss it: way [m] and angle [rad], (...) each. The angle is between the axes where
        one is free, of the turn where none is; with two free, of the turn about the one that counts.
        """
        T = np.asarray(T, dtype=float)
        e = self.error(T)
        way = np.linalg.norm(e[..., 3:], axis=-1)
        free = np.flatnonzero(~self.mask[:3])
        between = np.swapaxes(T[..., :3, :3], -1, -2) @ self.T[:3, :3]
        if len(free) == 1:
            z = between[..., free[0], :]
            across = np.linalg.norm(np.delete(z, free[0], axis=-1), axis=-1)
            return way, np.arctan2(across, z[..., free[0]])
        if len(free) == 3:
            return way, np.zeros_like(way)
        turn = so3.log(between)
        return way, np.linalg.norm(turn * self.mask[:3], axis=-1)


def _orthonormal(R: Array, counts: np.ndarray) -> Array:
    """The nearest rotation; where one axis is free of turning, the nearest that keeps this axis exactly."""
    free = np.flatnonzero(~counts)
    if len(free) != 1:
        return so3.nearest_rotation(R)
    c = int(free[0])
    j, k = (c + 1) % 3, (c + 2) % 3
    out = np.empty((3, 3))
    out[:, c] = R[:, c] / np.linalg.norm(R[:, c])
    x = R[:, j] - out[:, c] * (out[:, c] @ R[:, j])
    out[:, j] = x / np.linalg.norm(x)
    out[:, k] = np.cross(out[:, c], out[:, j])
    return out


# --- Inverse kinematics of many arms at once: postures that bring each arm's tool to one target

CONVERGED = 1e-9  # of the root sum of squares of the rows
_FAR = 1e-3
_LONGEST = 1.0  # rad or m, of one joint in one step


class Arms(NamedTuple):
    """N arms of n joints each, components first, every joint about or along z of the frame before it.

    R, p: rotations and positions of M_0 … M_n, (n + 1, 3, 3, N) and (n + 1, 3, N) [m]. revolute: (n, N). lower, upper:
    limits (n, N) [rad, m].
    """

    R: Array
    p: Array
    revolute: np.ndarray
    lower: Array
    upper: Array

    @classmethod
    def of(cls, assemblies: Sequence[Assembly], library: Library) -> Arms:
        """The arms that these assemblies of as many joints make; they have been checked."""
        M = np.stack([origins(assembly, library) for assembly in assemblies], axis=-1)
        kinds = [[library.types[module.kind] for module in assembly.joints] for assembly in assemblies]
        stated = np.array([[(kind.revolute, kind.lower, kind.upper) for kind in own] for own in kinds], dtype=float)
        revolute, lower, upper = stated.T
        return cls(M[:, :3, :3], M[:, :3, 3], revolute > 0.0, lower, upper)

    def take(self, which: np.ndarray) -> Arms:
        """Arms with these indices, which may repeat."""
        return Arms(*(np.take(part, which, axis=-1) for part in self))

    def too_short(self, target: Target) -> Array:
        """By how much a target is farther from the first joint than all modules in a line [m], (N,); 0: it is not."""
        if not target.mask[3:].all():
            return np.zeros(self.p.shape[-1])
        slides = np.where(self.revolute, 0.0, np.maximum(np.abs(self.lower), np.abs(self.upper)))
        longest = np.linalg.norm(self.p[1:], axis=1).sum(axis=0) + slides.sum(axis=0)
        return np.maximum(0.0, np.linalg.norm(target.T[:3, 3:] - self.p[0], axis=0) - longest)

    def starts(self, unit: Array) -> Array:
        """Postures (N, S, n) within the limits, from points of the unit cube (S, n)."""
        low, high = (side.T[:, None] for side in ranges(self.revolute, self.lower, self.upper))
        return np.asarray(low + unit * (high - low))


@dataclass(frozen=True)
class Reached:
    """Where descents ended. q: (N, S, n) [rad, m], within the limits; left: root sum of squares of the rows, (N, S)."""

    q: Array
    left: Array


def reach(arms: Arms, target: Target, q: Array, steps: int) -> Reached:
    """Ends of descents from postures q (N, S, n), after a limited number of steps."""
    count, each, n = q.shape
    fleet = arms.take(np.repeat(np.arange(count), each))
    q_now = np.clip(q.reshape(-1, n).T, fleet.lower, fleet.upper)
    q_end, left = q_now.copy(), np.empty(count * each)
    active = np.arange(count * each)
    r, J = _rows(fleet, target, q_now)
    cost = np.einsum("rn,rn->n", r, r)
    mu = 1e-2 * np.ones_like(cost)
    left[:], going = np.sqrt(cost), cost > CONVERGED**2
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
            active, fleet = active[going], fleet.take(np.flatnonzero(going))
            q_now, r, J, cost, mu = (np.compress(going, x, axis=-1) for x in (q_now, r, J, cost, mu))
            going = np.ones(len(active), bool)
    else:
        q_end[:, active], left[active] = q_now, np.sqrt(cost)
    return Reached(q_end.T.reshape(count, each, n), left.reshape(count, each))


def _rows(fleet: Arms, target: Target, q: Array) -> tuple[Array, Array]:
    """The rows (r, N) at postures q (n, N), and their derivatives (n, r, N)."""
    n, count = q.shape
    R, p = fleet.R[0], fleet.p[0]
    axes, places = np.empty((n, 3, count)), np.empty((n, 3, count))
    angle = np.where(fleet.revolute, q, 0.0)
    c, s, slid = np.cos(angle), np.sin(angle), q - angle
    for k in range(n):
        axes[k], places[k] = R[:, 2], p
        turned = np.stack([c[k] * R[:, 0] + s[k] * R[:, 1], c[k] * R[:, 1] - s[k] * R[:, 0], R[:, 2]])
        M, m = fleet.R[k + 1], fleet.p[k + 1]
        p = p + slid[k] * R[:, 2] + turned[0] * m[0] + turned[1] * m[1] + turned[2] * m[2]
        R = turned[0][:, None] * M[0] + turned[1][:, None] * M[1] + turned[2][:, None] * M[2]
    A, b = target.rows
    pose = [*R.swapaxes(0, 1), p]  # its columns, (3, N) each
    used = np.flatnonzero(A.any(axis=0).reshape(3, 4).any(axis=0))  # those that count
    A = A.reshape(-1, 3, 4)[:, :, used].swapaxes(1, 2).reshape(len(A), -1)
    r = A @ np.concatenate([pose[column] for column in used]) - b[:, None]
    J = np.empty((n, len(A), count))
    for k, (axis, turns) in enumerate(zip(axes, fleet.revolute, strict=True)):
        moved = [cross(axis, p - places[k] if column == 3 else pose[column]) for column in used]
        if not turns.all():
            moved = [np.where(turns, dx, axis if column == 3 else 0.0) for dx, column in zip(moved, used, strict=True)]
        J[k] = A @ np.concatenate(moved)
    return r, J


def _step(fleet: Arms, q: Array, r: Array, J: Array, mu: Array) -> Array:
    """The next postures (n, N): damped, no longer than allowed, within the limits."""
    g = np.einsum("krn,rn->kn", J, r)
    held = ((q <= fleet.lower) & (g > 0.0)) | ((q >= fleet.upper) & (g < 0.0))
    if held.any():
        J, g = np.where(held[:, None], 0.0, J), np.where(held, 0.0, g)
    H = np.einsum("irn,jrn->nij", J, J) + mu[:, None, None] * np.eye(len(q))
    step = -np.linalg.solve(H, g.T[..., None])[..., 0].T
    step *= np.minimum(1.0, _LONGEST / np.maximum(np.abs(step).max(axis=0), 1e-300))
    return np.clip(q + step, fleet.lower, fleet.upper)

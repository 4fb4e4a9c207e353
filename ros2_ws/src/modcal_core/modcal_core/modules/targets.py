"""Tool poses that an arm must reach, the search for postures that do, and tables over all genes of modules.

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

Numbers stand with their components first and the arms last, one long contiguous axis: a thousand descents cost little
more than the overhead of one. The constant M_k behind joint k, its tubes, masses and limits are functions of the gene
alone: all are computed once and then only indexed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.geometry import Array, cross, se3, sealed, so3
from modcal_core.modules.coding import BASES, Coding
from modcal_core.modules.library import SIZES, TURN, TURNS, ModuleType
from modcal_core.modules.urdf import body, path


@dataclass(frozen=True)
class Arms:
    """N assemblies of n joints each, their kinematics along the first axis.

    origins: M_0 … M_n, (N, n + 1, 4, 4) [m], every joint about or along z of the frame before it. revolute: (N, n).
    lower, upper: (N, n) [rad, m].
    """

    origins: Array
    revolute: np.ndarray
    lower: Array
    upper: Array

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.revolute.shape[1]

    def take(self, which: np.ndarray) -> Arms:
        """Arms with these indices, which may repeat."""
        return Arms(self.origins[which], self.revolute[which], self.lower[which], self.upper[which])


@dataclass(frozen=True)
class ModuleBodies:
    """What moves with each joint of N arms, seen from the frame behind its motion; base and gripper apart.

    points: corners of the tubes' middle lines, (N, n, P, 3) [m]; radius: of the tubes between them, (N, n, P - 1) [m],
    0 where there is none. base, base_radius: the same of the base, in the base frame, (N, Q, 3) and (N,). mass: (N, n)
    [kg], centre: (N, n, 3) [m]; the gripper is part of the last. effort: what the joints can do, (N, n) [N m, N].
    """

    points: Array
    radius: Array
    base: Array
    base_radius: Array
    mass: Array
    centre: Array
    effort: Array


@dataclass(frozen=True)
class _Tables:
    """k modules, one length each: ways T (k, 4, 4), middle lines (k, P, 3) [m], radius (k,) [m], mass (k,) [kg], centre
    (k, 3) [m]; where there is no module nothing counts, for such genes are refused before.
    """

    T: Array
    points: Array
    radius: Array
    mass: Array
    centre: Array

    @classmethod
    def of(cls, modules: Iterable[tuple[ModuleType | None, int]], points: int) -> _Tables:
        """The tables of modules of these lengths; lines end with their last point repeated."""
        rows: list[tuple[Any, ...]] = []
        for kind, size in modules:
            if kind is None or size >= kind.sizes:
                rows.append((np.eye(4), np.zeros((points, 3)), 0.0, 1.0, np.zeros(3)))
                continue
            line, whole = path(kind, size), body(kind, size)
            line = np.concatenate([line, np.tile(line[-1], (points - len(line), 1))])
            rows.append((kind.T_in_out[size], line, kind.radius, whole.mass, whole.centre))
        return cls(*(np.array(column) for column in zip(*rows, strict=True)))

    def take(self, which: np.ndarray) -> _Tables:
        """Those with these numbers."""
        return _Tables(*(getattr(self, f.name)[which] for f in fields(self)))


class Catalogue:
    """Tables over all genes and bases of a coding."""

    def __init__(self, coding: Coding) -> None:
        self.coding = coding
        library, bases = coding.library, np.arange(BASES)
        P = 2 + max(len(kind.elbows) for kind in library.types.values())
        joint, turn, link, size, next_turn = coding.fields(np.arange(coding.genes))
        joints = _Tables.of(((kind, 0) for kind in coding.joints), P).take(joint)
        links = _Tables.of(((kind, s) for kind in coding.links for s in range(SIZES)), P).take(link * SIZES + size)
        self._tool = _Tables.of([(library.gripper, 0)], P)
        self._base = _Tables.of(((library.base, min(b // TURNS, library.base.sizes - 1)) for b in range(BASES)), P)
        T_flange = joints.T @ TURN[turn]  # where the link begins, behind the joint's motion
        self._M = T_flange @ links.T @ TURN[next_turn]
        self._M_base = self._base.T @ TURN[bases % TURNS]
        # where one module ends the next begins: the tube between the two has no length, and no radius
        self._points = np.concatenate([joints.points, se3.apply(T_flange[:, None], links.points)], axis=1)
        tubes = [np.repeat(part.radius[:, None], P - 1, axis=1) for part in (joints, links)]
        self._radius = np.concatenate([tubes[0], np.zeros((len(joint), 1)), tubes[1]], axis=1)
        self._mass = joints.mass + links.mass
        self._moment = joints.mass[:, None] * joints.centre
        self._moment += links.mass[:, None] * se3.apply(T_flange, links.centre)
        self._revolute = np.array([kind is None or kind.revolute for kind in coding.joints])[joint]
        limits = [(-1.0, 1.0, 0.0) if kind is None else (kind.lower, kind.upper, kind.effort) for kind in coding.joints]
        self._lower, self._upper, self._effort = np.array(limits)[joint].T

    def arms(self, genomes: np.ndarray) -> Arms:
        """Kinematics of genomes (N, n + 1)."""
        genes = genomes[:, 1:]
        M = np.concatenate([self._M_base[genomes[:, :1]], self._M[genes]], axis=1)
        M[:, -1] = M[:, -1] @ self._tool.T[0]
        return Arms(M, self._revolute[genes], self._lower[genes], self._upper[genes])

    def bodies(self, genomes: np.ndarray) -> ModuleBodies:
        """Tubes, masses and strengths of genomes (N, n + 1)."""
        genes, tool = genomes[:, 1:], self._tool
        P = tool.points.shape[1]
        # no gripper but at the last joint: a tube without length
        points = np.pad(self._points[genes], ((0, 0), (0, 0), (0, P), (0, 0)), mode="edge")
        radius = np.pad(self._radius[genes], ((0, 0), (0, 0), (0, P)))
        T = self._M[genes[:, -1]]
        points[:, -1, -P:] = se3.apply(T[:, None], tool.points[0])
        radius[:, -1, -(P - 1) :] = tool.radius[0]
        mass, moment = self._mass[genes], self._moment[genes]
        mass[:, -1] += tool.mass[0]
        moment[:, -1] += tool.mass[0] * se3.apply(T, tool.centre[0])
        base = self._base.take(genomes[:, 0])
        return ModuleBodies(
            points, radius, base.points, base.radius, mass, moment / mass[..., None], self._effort[genes]
        )


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
        """How far poses (..., 4, 4) miss it: way [m] and angle [rad], (...) each, of what counts.

        The angle is that between the axes where one is free, else that of the turn where none is; with two free, the
        part of the turn about the one that counts.
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


# --- Where the parts of many arms are at given postures: what the requirements look at


@dataclass(frozen=True)
class TargetPostures:
    """N arms at S postures for each of K targets. q: (N, K, S, n) [rad, m]."""

    arms: Arms
    bodies: ModuleBodies
    targets: tuple[Target, ...]
    q: Array

    @cached_property
    def _frames(self) -> tuple[Array, Array, Array]:
        return frames(self.arms, self.q)

    @property
    def before(self) -> Array:
        """Frames before every joint's motion, its axis as z, in the base, (N, K, S, n, 4, 4) [m]."""
        return self._frames[0]

    @property
    def behind(self) -> Array:
        """Frames behind every joint's motion, (N, K, S, n, 4, 4) [m]."""
        return self._frames[1]

    @property
    def tip(self) -> Array:
        """The tool in the base, (N, K, S, 4, 4) [m]."""
        return self._frames[2]

    @cached_property
    def task_jacobian(self) -> Array:
        """What the joints do to the tool, turn and way in the target's frame, masked, (N, K, S, 6, n)."""
        z, p = self.before[..., :3, 2], self.before[..., :3, 3]
        turning = self.arms.revolute[:, None, None, :, None]
        w = np.where(turning, z, 0.0)
        v = np.where(turning, np.cross(z, self.tip[..., None, :3, 3] - p), z)
        R = np.stack([t.T[:3, :3] for t in self.targets])[:, None]
        mask = np.stack([t.mask for t in self.targets])[:, None, None]
        out: Array = np.swapaxes(np.concatenate([w @ R, v @ R], axis=-1) * mask, -1, -2)
        return out


def frames(arms: Arms, q: Array) -> tuple[Array, Array, Array]:
    """Frames before and behind the motion of every joint, (N, ..., n, 4, 4), and the tool (N, ..., 4, 4) [m].

    q: (N, ..., n) [rad, m].
    """
    between = (1,) * (q.ndim - 2)
    shape = q.shape[:-1]
    T = np.broadcast_to(arms.origins[:, 0].reshape(-1, *between, 4, 4), (*shape, 4, 4))
    before, behind = np.empty((*q.shape, 4, 4)), np.empty((*q.shape, 4, 4))
    for k in range(arms.n):
        turning = arms.revolute[:, k].reshape(-1, *between)
        xi = np.zeros((*shape, 6))
        xi[..., 5] = np.where(turning, q[..., k], 0.0)
        xi[..., 2] = np.where(turning, 0.0, q[..., k])
        before[..., k, :, :] = T
        T = T @ se3.exp(xi)
        behind[..., k, :, :] = T
        T = T @ arms.origins[:, k + 1].reshape(-1, *between, 4, 4)
    return before, behind, T


# --- Inverse kinematics of many arms at once: postures that bring each arm's tool to one target

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
    fleet = _Fleet.of(arms, np.repeat(np.arange(count), each))
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
            active, fleet = active[going], _Fleet(*(np.compress(going, x, axis=-1) for x in fleet))
            q_now, r, J, cost, mu = (np.compress(going, x, axis=-1) for x in (q_now, r, J, cost, mu))
            going = np.ones(len(active), bool)
    else:
        q_end[:, active], left[active] = q_now, np.sqrt(cost)
    return Reached(q_end.T.reshape(count, each, n), left.reshape(count, each))


class _Fleet(NamedTuple):
    """The arms again, components first: rotations and positions of M_k, (n + 1, 3, 3, N), (n + 1, 3, N)."""

    R: Array
    p: Array
    revolute: np.ndarray
    lower: Array
    upper: Array

    @classmethod
    def of(cls, arms: Arms, which: np.ndarray) -> _Fleet:
        M = np.ascontiguousarray(np.moveaxis(arms.origins, 0, -1)[..., which])
        rest = (np.ascontiguousarray(a.T[:, which]) for a in (arms.revolute, arms.lower, arms.upper))
        return cls(M[:, :3, :3], M[:, :3, 3], *rest)


def _rows(fleet: _Fleet, target: Target, q: Array) -> tuple[Array, Array]:
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


def _step(fleet: _Fleet, q: Array, r: Array, J: Array, mu: Array) -> Array:
    """The next postures (n, N): damped, no longer than allowed, within the limits."""
    g = np.einsum("krn,rn->kn", J, r)
    held = ((q <= fleet.lower) & (g > 0.0)) | ((q >= fleet.upper) & (g < 0.0))
    if held.any():
        J, g = np.where(held[:, None], 0.0, J), np.where(held, 0.0, g)
    H = np.einsum("irn,jrn->nij", J, J) + mu[:, None, None] * np.eye(len(q))
    step = -np.linalg.solve(H, g.T[..., None])[..., 0].T
    step *= np.minimum(1.0, _LONGEST / np.maximum(np.abs(step).max(axis=0), 1e-300))
    return np.clip(q + step, fleet.lower, fleet.upper)

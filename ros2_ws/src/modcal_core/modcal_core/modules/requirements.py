"""What an assembly is judged by, each requirement one small function, all in one table.

What breaks a *hard* one is rejected; *soft* ones cost, each with its weight. Some are both. A function says by how much
a hard one is broken (0: it is met), so that a search sees which of two rejected candidates is nearer, and what a soft
one costs: of an arm, one number each, or one for each posture that may reach a target, (K, S). The first two are asked
of many genomes or arms at once, and what they reject is looked at no further (:mod:`modcal_core.modules.evaluation`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from modcal_core.geometry import Array, se3
from modcal_core.modules.coding import Coding
from modcal_core.modules.library import Assembly, Library, chain_of, module_frames
from modcal_core.modules.targets import Target
from modcal_core.modules.urdf import body, path
from modcal_core.robots import STANDARD_GRAVITY, Chain, body_jacobian, chain_forward, frames, joint_ranges

STRUCTURE, REACH = "structure", "reachability"
Options = Mapping[str, Any]
_TRIES, _SWEEPS = 16, 6


@dataclass(frozen=True)
class BuiltArm:
    """An arm that is judged. q: postures (K, S, n) [rad, m], S of them for each of K targets."""

    assembly: Assembly
    library: Library
    targets: tuple[Target, ...]
    q: Array

    @cached_property
    def chain(self) -> Chain:
        """Its kinematics."""
        return chain_of(self.assembly, self.library)

    @cached_property
    def frames(self) -> Array:
        """Where its modules are, and at last the tool, (K, S, modules + 1, 4, 4) [m]."""
        return module_frames(self.assembly, self.library, self.q)


Measured = tuple[Array | float, Array | float]  # by how much it is broken, and what it costs


@dataclass(frozen=True)
class Requirement:
    """One requirement. measure: of an arm; None for those that stand by themselves. hard, soft: what it can be.

    options: its own, with their defaults; None where the user must give one. weight: of its cost, where none is given.
    worst: whether the target that fares worst counts, and not the sum over all.
    """

    measure: Callable[[BuiltArm, Options], Measured] | None
    hard: bool
    soft: bool
    options: Options = field(default_factory=dict)
    weight: float = 0.0
    worst: bool = True


def structure(genomes: np.ndarray, coding: Coding) -> Array:
    """How many of the printed rules each genome (N, n + 1) breaks, counting every place, (N,).

    Two turning joints that a straight link joins are one; so are two sliding ones; and no two straight links follow
    each other, but for the last. A gene that the library cannot build counts too. Straight: out along the joint's axis.
    """
    joint, _, link, _, _ = coding.fields(genomes[:, 1:])
    turns = np.array([kind is not None and kind.revolute for kind in coding.joints])[joint]
    line = np.array([kind is not None and _straight(kind.T_in_out) for kind in coding.links])[link]
    alike = (turns[:, :-1] == turns[:, 1:]) & line[:, :-1]
    twice = line[:, :-2] & line[:, 1:-1]
    unknown = ~coding.buildable[genomes[:, 1:]]
    out = alike.sum(axis=1) + twice.sum(axis=1) + unknown.sum(axis=1) + ~coding.base_buildable[genomes[:, 0]]
    return np.asarray(out, dtype=float)


def _straight(T: Array) -> bool:
    return bool(np.abs(T[:, :2, 3]).max() < 1e-9 and np.abs(T[:, :3, 2] - [0.0, 0.0, 1.0]).max() < 1e-9)


def upright(arm: BuiltArm, options: Options) -> Measured:
    """Distance of the tool from the base's z axis with all joints at zero [m]: a cost."""
    return 0.0, float(np.hypot(*arm.chain.home[:2, 3]))


def far_reach(arm: BuiltArm, options: Options) -> Measured:
    """What is missing to ``at_least_m``, and how near the farthest point is, both [m]."""
    farthest = farthest_reach(arm.chain)
    return max(0.0, float(options["at_least_m"]) - farthest), -farthest


def farthest_reach(chain: Chain) -> float:
    """The farthest that the tool gets from the first joint, within the limits [m].

    Joint by joint the distance is the largest there is: for a turning one its square is c + A cos q + B sin q. From
    several postures, so it may come out a little short of the truth, never long.
    """
    low, high = joint_ranges(chain)
    q = np.random.default_rng(0).uniform(low, high, (_TRIES, chain.n))
    shoulder = chain.origins[0, :3, 3]
    for _ in range(_SWEEPS):
        before = q.copy()
        for k in range(chain.n):
            f = frames(chain, q)
            # shoulder and tip seen from before the joint; of −2 a · Rz(change) b the parts with its cosine and sine
            a, b = (np.einsum("dcn,cn->dn", f.axes[k], (p - f.p[k].T).T) for p in (shoulder, f.p[-1].T))
            phase = q[:, k] + np.arctan2(a[0] * b[1] - a[1] * b[0], -(a[0] * b[0] + a[1] * b[1]))
            top = phase - 2.0 * np.pi * np.ceil((phase - high[k]) / (2.0 * np.pi))  # the largest that is no higher
            nearer = np.cos(low[k] - phase) > np.cos(high[k] - phase)
            slid = np.abs(low[k] - q[:, k] + b[2] - a[2]) > np.abs(high[k] - q[:, k] + b[2] - a[2])
            ends = np.where(nearer if chain.revolute[k] else slid, low[k], high[k])
            q[:, k] = np.where(chain.revolute[k] & (top >= low[k]), top, ends)
        if np.array_equal(q, before):
            break
    return float(np.linalg.norm(chain_forward(chain, q)[:, :3, 3] - shoulder, axis=1).max())


def joint_range(arm: BuiltArm, options: Options) -> Measured:
    """How far the worst joint is beyond its limits, in half ranges, and e^(K − ½), added up over joints with K ≥ ½.

    K = |q − middle| / half range: 0 in the middle, 1 at the limits. A joint without limits costs nothing.
    """
    limited = np.isfinite(arm.chain.lower) & np.isfinite(arm.chain.upper)
    lower, upper = arm.chain.lower[limited], arm.chain.upper[limited]
    K = np.abs(arm.q[..., limited] - 0.5 * (upper + lower)) / (0.5 * (upper - lower))
    beyond = np.maximum(0.0, K.max(axis=-1, initial=0.0) - 1.0 - 1e-9)
    return beyond, np.where(K >= 0.5, np.exp(K - 0.5), 0.0).sum(axis=-1)


def dexterity(arm: BuiltArm, options: Options) -> Measured:
    """Nothing, and −w: Yoshikawa's manipulability of what the mask asks for, √det(J Jᵀ), turns in rad, ways in m."""
    w = np.zeros(arm.q.shape[:2])
    for k, (target, q) in enumerate(zip(arm.targets, arm.q, strict=True)):
        if target.constraints <= arm.chain.n:
            across = target.T[:3, :3].T @ chain_forward(arm.chain, q)[:, :3, :3]
            J = body_jacobian(arm.chain, q)
            rows = np.concatenate([across @ J[:, 3:], across @ J[:, :3]], axis=1)[:, target.mask]
            # as the product of singular values, which is exact where the determinant is rounding
            w[k] = np.linalg.svd(rows, compute_uv=False).prod(axis=-1)
    return 0.0, -w


def payload(arm: BuiltArm, options: Options) -> Measured:
    """How much more than its ``effort`` the worst joint needs to hold ``mass_kg`` and the arm still, and what it needs.

    Both as shares of the effort: 1 is all of it. Gravity along −z of the base; masses and efforts from the library.
    """
    kinds = [arm.library.types[module.kind] for module in arm.assembly.modules]
    bodies = [body(kind, module.size) for kind, module in zip(kinds, arm.assembly.modules, strict=True)]
    joints = slice(1, 2 * arm.assembly.n, 2)
    z, p = arm.frames[..., joints, :3, 2], arm.frames[..., joints, :3, 3]
    weight = STANDARD_GRAVITY * np.array([*(one.mass for one in bodies), float(options["mass_kg"])])
    centres = se3.apply(arm.frames, np.stack([*(one.centre for one in bodies), np.zeros(3)]))
    # sums over the bodies from each joint on
    beyond = np.cumsum(weight[::-1])[::-1][joints, None]
    moment = np.flip(np.cumsum(np.flip(weight[:, None] * centres, -2), axis=-2), -2)[..., joints, :]
    lever = moment - beyond * p
    torque = z[..., 1] * lever[..., 0] - z[..., 0] * lever[..., 1]  # z · (c − p) × (0, 0, −w)
    needed = np.abs(np.where([kind.revolute for kind in kinds[joints]], torque, z[..., 2] * beyond[:, 0]))
    share = (needed / np.maximum([kind.effort for kind in kinds[joints]], 1e-9)).max(axis=-1)
    return np.maximum(0.0, share - 1.0), share


def obstacles(arm: BuiltArm, options: Options) -> Measured:
    """How much of ``margin_m`` is missing between the arm's tubes and the spheres, and −clearance, both [m].

    At the postures that reach the targets; the ways between them are for a planner. spheres: {center_m, radius_m}.
    """
    free = np.full(arm.q.shape[:2], np.inf)
    for i, module in enumerate(arm.assembly.modules):
        kind = arm.library.types[module.kind]
        points = se3.apply(arm.frames[..., i, None, :, :], path(kind, module.size))
        free = np.minimum(free, _clearance(points, options["spheres"]) - kind.radius)
    return np.maximum(0.0, float(options["margin_m"]) - free), -free


def _clearance(points: Array, spheres: Sequence[Mapping[str, Any]]) -> Array:
    """Least distance of lines (..., P, 3) from the spheres [m], (...)."""
    a, way = points[..., :-1, :], np.diff(points, axis=-2)
    square = np.maximum((way * way).sum(axis=-1), 1e-18)
    out = np.full(a.shape[:-2], np.inf)
    for sphere in spheres:
        to = np.asarray(sphere["center_m"], dtype=float) - a
        along = np.clip((to * way).sum(axis=-1) / square, 0.0, 1.0)
        distance = np.linalg.norm(to - along[..., None] * way, axis=-1)
        out = np.minimum(out, distance.min(axis=-1) - float(sphere["radius_m"]))
    return out


REQUIREMENTS: Mapping[str, Requirement] = {
    STRUCTURE: Requirement(None, True, False),
    REACH: Requirement(None, True, False, {"tolerance": 1e-6}),
    "reach": Requirement(far_reach, True, True, {"at_least_m": None}),
    "joint_range": Requirement(joint_range, True, True, weight=1.0, worst=False),
    "payload": Requirement(payload, True, True, {"mass_kg": None}),
    "obstacles": Requirement(obstacles, True, True, {"spheres": None, "margin_m": 0.0}),
    "dexterity": Requirement(dexterity, False, True, weight=1.0),
    "upright": Requirement(upright, False, True, weight=1.0),
}

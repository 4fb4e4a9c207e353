"""What an assembly is judged by, each requirement one small function, all in one table.

What breaks a *hard* one is rejected; *soft* ones cost, and costs are added up, each with its weight. Some are both. A
function says by how much a hard one is broken (0: it is met), so that a search sees which of two rejected candidates is
nearer, and what a soft one costs. By what they look at there are three:

    code       the genome alone: (genomes, coding, options) → (N,)
    arm        the arm, whatever its posture: (arms, options) → (N,), (N,)
    posture    the arm where it reaches a target: (postures, options) → (N, K, S), (N, K, S)

Whether an arm reaches its targets at all stands between: :mod:`modcal_core.modules.evaluation`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from modcal_core.geometry import Array, se3
from modcal_core.modules.coding import Coding
from modcal_core.modules.targets import Arms, TargetPostures, frames, starts
from modcal_core.robots import STANDARD_GRAVITY

CODE, REACH, ARM, POSTURE = "code", "reachability", "arm", "posture"
Options = Mapping[str, Any]
_FREE_SLIDE = 0.5  # m; how far a sliding joint without limits is taken to go
_SWEEPS = 6


@dataclass(frozen=True)
class Requirement:
    """One requirement. looks_at: which of the three it is; hard, soft: what it can be.

    options: its own, with their defaults; None where the user must give one. weight: of its cost, where none is given.
    worst: whether the target that fares worst counts, and not the sum over all.
    """

    looks_at: str
    measure: Callable[..., Any] | None
    hard: bool
    soft: bool
    options: Options = field(default_factory=dict)
    weight: float = 0.0
    worst: bool = True


def structure(genomes: np.ndarray, coding: Coding, options: Options) -> Array:
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


def upright(arms: Arms, options: Options) -> tuple[Array, Array]:
    """Distance of the tool from the base's z axis with all joints at zero [m]: a cost, (N,)."""
    _, _, tip = frames(arms, np.zeros((len(arms.lower), arms.n)))
    return np.zeros(len(tip)), np.hypot(tip[:, 0, 3], tip[:, 1, 3])


def far_reach(arms: Arms, options: Options) -> tuple[Array, Array]:
    """What is missing to ``at_least_m``, and how near the farthest point is, both [m], (N,)."""
    farthest = farthest_reach(arms)
    return np.maximum(0.0, float(options["at_least_m"]) - farthest), -farthest


def farthest_reach(arms: Arms, tries: int = 16) -> Array:
    """The farthest that the tool gets from the first joint, within the limits [m], (N,).

    Joint by joint the distance is the largest there is: for a turning one its square is c + A cos q + B sin q. From
    several postures, so it may come out a little short of the truth, never long.
    """
    unit = np.random.default_rng(0).random((tries, arms.n))
    q = starts(arms, unit)
    low = np.where(np.isfinite(arms.lower), arms.lower, np.where(arms.revolute, -np.pi, -_FREE_SLIDE))
    high = np.where(np.isfinite(arms.upper), arms.upper, np.where(arms.revolute, np.pi, _FREE_SLIDE))
    shoulder = arms.origins[:, None, 0, :3, 3]
    for _ in range(_SWEEPS):
        for k in range(arms.n):
            before, behind, tip = frames(arms, q)
            a = se3.apply(se3.inverse(before[:, :, k]), shoulder)
            b = se3.apply(se3.inverse(behind[:, :, k]), tip[..., :3, 3])
            # of −2 a · Rz(q) b the parts with cos q and sin q
            A = -2.0 * (a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1])
            B = -2.0 * (a[..., 1] * b[..., 0] - a[..., 0] * b[..., 1])
            lo, hi = low[:, k, None], high[:, k, None]
            top = np.arctan2(B, A)
            ends = np.where(A * np.cos(lo) + B * np.sin(lo) > A * np.cos(hi) + B * np.sin(hi), lo, hi)
            turned = np.where((top >= lo) & (top <= hi), top, ends)
            slid = np.where(np.abs(lo + b[..., 2] - a[..., 2]) > np.abs(hi + b[..., 2] - a[..., 2]), lo, hi)
            q[..., k] = np.where(arms.revolute[:, k, None], turned, slid)
    _, _, tip = frames(arms, q)
    out: Array = np.linalg.norm(tip[..., :3, 3] - shoulder, axis=-1).max(axis=1)
    return out


def joint_range(postures: TargetPostures, options: Options) -> tuple[Array, Array]:
    """How far the worst joint is beyond its limits, in half ranges, and e^(K − ½), added up over joints with K ≥ ½.

    K = |q − middle| / half range: 0 in the middle, 1 at the limits. A joint without limits costs nothing.
    """
    lower, upper = postures.arms.lower[:, None, None], postures.arms.upper[:, None, None]
    limited = np.isfinite(lower) & np.isfinite(upper)
    half = np.where(limited, 0.5 * (upper - lower), 1.0)
    middle = np.where(limited, 0.5 * (upper + lower), 0.0)
    K = np.where(limited, np.abs(postures.q - middle) / half, 0.0)
    return np.maximum(0.0, K.max(axis=-1) - 1.0 - 1e-9), np.where(K >= 0.5, np.exp(K - 0.5), 0.0).sum(axis=-1)


def dexterity(postures: TargetPostures, options: Options) -> tuple[Array, Array]:
    """Nothing, and −w: Yoshikawa's manipulability of what the mask asks for, √det(J Jᵀ), turns in rad, ways in m."""
    J = postures.task_jacobian
    w = np.empty(J.shape[:3])
    for k, target in enumerate(postures.targets):
        rows = J[:, k][..., target.mask, :]
        # as the product of singular values, which is exact where the determinant is rounding
        w[:, k] = np.linalg.svd(rows, compute_uv=False).prod(axis=-1) if rows.shape[-2] <= rows.shape[-1] else 0.0
    return np.zeros_like(w), -w


def payload(postures: TargetPostures, options: Options) -> tuple[Array, Array]:
    """How much more than its ``effort`` the worst joint needs to hold ``mass_kg`` and the arm still, and what it needs.

    Both as shares of the effort: 1 is all of it. Gravity along −z of the base; masses and efforts from the library.
    """
    bodies = postures.bodies
    weight = bodies.mass[:, None, None, :, None] * STANDARD_GRAVITY
    centre = se3.apply(postures.behind, bodies.centre[:, None, None])
    load = float(options["mass_kg"]) * STANDARD_GRAVITY
    # sums over the bodies from each joint on
    beyond = np.flip(np.cumsum(np.flip(weight, -2), axis=-2), -2) + load
    moment = np.flip(np.cumsum(np.flip(weight * centre, -2), axis=-2), -2) + load * postures.tip[..., None, :3, 3]
    z, p = postures.before[..., :3, 2], postures.before[..., :3, 3]
    arm = moment - beyond * p
    torque = -(z[..., 0] * arm[..., 1] - z[..., 1] * arm[..., 0])  # z · (c − p) × (0, 0, −w)
    force = -z[..., 2] * beyond[..., 0]
    needed = np.abs(np.where(postures.arms.revolute[:, None, None], torque, force))
    share = (needed / np.maximum(bodies.effort[:, None, None], 1e-9)).max(axis=-1)
    return np.maximum(0.0, share - 1.0), share


def obstacles(postures: TargetPostures, options: Options) -> tuple[Array, Array]:
    """How much of ``margin_m`` is missing between the arm's tubes and the spheres, and −clearance, both [m].

    At the postures that reach the targets; the ways between them are for a planner. spheres: {center_m, radius_m}.
    """
    bodies = postures.bodies
    points = se3.apply(postures.behind[..., None, :, :], bodies.points[:, None, None])  # (N, K, S, n, P, 3)
    free = _clearance(points, bodies.radius[:, None, None], options).min(axis=(-1, -2))
    base = _clearance(bodies.base, bodies.base_radius[:, None], options).min(axis=-1)
    free = np.minimum(free, base[:, None, None])
    return np.maximum(0.0, float(options["margin_m"]) - free), -free


def _clearance(points: Array, radius: Array, options: Options) -> Array:
    """Least distance of every tube of lines (..., P, 3) from the spheres [m], (..., P - 1); inf where there is none."""
    a, way = points[..., :-1, :], np.diff(points, axis=-2)
    square = np.maximum((way * way).sum(axis=-1), 1e-18)
    out = np.full(a.shape[:-1], np.inf)
    for sphere in options["spheres"]:
        to = np.asarray(sphere["center_m"], dtype=float) - a
        along = np.clip((to * way).sum(axis=-1) / square, 0.0, 1.0)
        distance = np.linalg.norm(to - along[..., None] * way, axis=-1)
        out = np.minimum(out, distance - float(sphere["radius_m"]) - radius)
    return np.where(radius > 0.0, out, np.inf)


REQUIREMENTS: Mapping[str, Requirement] = {
    "structure": Requirement(CODE, structure, True, False),
    "reachability": Requirement(REACH, None, True, False, {"tolerance": 1e-6}),
    "reach": Requirement(ARM, far_reach, True, True, {"at_least_m": None}),
    "joint_range": Requirement(POSTURE, joint_range, True, True, weight=1.0, worst=False),
    "payload": Requirement(POSTURE, payload, True, True, {"mass_kg": None}),
    "obstacles": Requirement(POSTURE, obstacles, True, True, {"spheres": None, "margin_m": 0.0}),
    "dexterity": Requirement(POSTURE, dexterity, False, True, weight=1.0),
    "upright": Requirement(ARM, upright, False, True, weight=1.0),
}

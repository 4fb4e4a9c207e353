"""What calibration asks of a robot, whatever it is built like: a serial chain or a Delta. Here are the functions whose
formulas differ and that need kinematics.

Inverse kinematics: the posture that puts the tip where it is wanted, by Newton's method, damped as Levenberg and
Marquardt do, on the error seen from the tip,

    e = (Rᵀ (p_d − p), log(Rᵀ R_d)),        de/dq = −[[I, −hat(e_p)], [0, J_l⁻¹(e_ω)]] J_body,

with the damping in proportion to the squared error (Sugihara 2011): it holds far steps back and vanishes close to the
solution, also where a redundant arm leaves steps undecided. A joint that would leave its limits is held at them. Where
that ends in a dead end, other postures are tried: all rows, one start for one pose each, descend at once, each with its
own damping, and drop out when they have arrived or get no nearer.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, TypeAlias, TypeGuard

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import NotReachable
from modcal_core.geometry import Array, crossed_rows, se3, so3
from modcal_core.robots import bodies, delta_kinematics, kinematics
from modcal_core.robots.chain import Chain, ranges
from modcal_core.robots.delta import Delta
from modcal_core.robots.kinematics import Frames, frames, tip_motions
from modcal_core.robots.urdf_inertias import HeldBehind, Inertias

ALL_SIX = (True, True, True, True, True, True)
TOLERANCE = 1e-10  # m and rad
RESTARTS = 1000  # a start in a hundred leads to a pose that only a corner of the limits reaches
_FIRST_RESTARTS = 30  # at once; then as many again as before, until one arrives
_MAX_STEPS = 100  # accepted or not
_MAX_REFUSED = 6  # steps in a row that made it worse
LONGEST = 0.6  # rad or m, of one joint in one step
DAMPING = 1e-3  # times the squared error


def inverse(
    chain: Chain,
    T_base_tip: ArrayLike,
    seed: ArrayLike,
    mask: ArrayLike = ALL_SIX,
    rng: np.random.Generator | None = None,
    restarts: int = RESTARTS,
    tolerance: float = TOLERANCE,
) -> Array:
    """Joint positions (n,) [rad, m] within the limits that put the tip at a pose (4, 4) of the base.

    seed: posture (n,) to begin from; the solution near it is found, turns counted, where there is one. mask: which of
    x y z rx ry rz, along and about the axes of the tip as it will be, must be met. rng: draws the postures of up to
    ``restarts`` other tries; without it only the seed is tried. tolerance: largest error [m and rad] of what must be
    met. Raises NotReachable with the smallest error found.
    """
    goal, start = np.asarray(T_base_tip, dtype=float), np.asarray(seed, dtype=float)
    assert goal.shape == (4, 4), goal.shape
    assert start.shape == (chain.n,), start.shape
    found = inverse_batch(chain, goal, start[None], mask, tolerance).best()
    tried = 0
    while not found.met and rng is not None and tried < restarts:
        count = min(max(_FIRST_RESTARTS, tried), restarts - tried)
        others = inverse_batch(chain, goal, chain.drawn(count, rng), mask, tolerance)
        both = (np.concatenate([a[None], b]) for a, b in zip(found, others, strict=True))
        found, tried = InverseResult(*both).best(), tried + count
    if found.met:
        return _unwound(chain, found.q, start)
    position, rotation = float(np.linalg.norm(found.error[:3])), float(np.linalg.norm(found.error[3:]))
    x, y, z = goal[:3, 3]
    raise NotReachable(
        f"pose of {chain.tip} at ({x:.3f}, {y:.3f}, {z:.3f}) m in {chain.base}",
        f"the nearest posture found within the limits misses it by {1e3 * position:.3g} mm, {rotation:.3g} rad",
        "ask for a pose within reach and away from the limits, or start from another posture",
        position,
        rotation,
        found.q,
    )


def _unwound(chain: Chain, q: Array, seed: Array) -> Array:
    """The same posture with whole turns taken off where that is closer to the seed and within the limits."""
    turns = np.where(chain.revolute, np.round((q - seed) / (2.0 * np.pi)), 0.0)
    nearer = q - 2.0 * np.pi * turns
    return chain.followed(np.where((nearer >= chain.lower) & (nearer <= chain.upper), nearer, q))


class InverseResult(NamedTuple):
    """What the rows came to; leading axes are those of the poses and starts, broadcast.

    q: joint positions (..., n) [rad, m], within the limits. error: (..., 6) [m, rad] seen from the tip, zero where the
    mask wants nothing. met: whether all that is wanted is met, (...).
    """

    q: Array
    error: Array
    met: np.ndarray

    def best(self) -> InverseResult:
        """For each pose the start, along the last batch axis, that came nearest; the first of those that arrived."""
        size = np.where(self.met, -1.0, np.linalg.norm(self.error, axis=-1))
        k = np.argmin(size, axis=-1)[..., None]
        q, error = (np.take_along_axis(a, k[..., None], axis=-2)[..., 0, :] for a in (self.q, self.error))
        return InverseResult(q, error, np.take_along_axis(self.met, k, axis=-1)[..., 0])


def inverse_batch(
    chain: Chain,
    T_base_tip: ArrayLike,
    starts: ArrayLike,
    mask: ArrayLike = ALL_SIX,
    tolerance: float = TOLERANCE,
) -> InverseResult:
    """Where damped Newton steps lead from every start towards its pose; a start that gets nowhere is no error.

    T_base_tip: poses (..., 4, 4) in the base [m]; starts: (..., n) [rad, m], put within the limits; their leading axes
    are broadcast: poses (K, 1, 4, 4) and starts (S, n) try S starts for each of K poses. mask: of x y z rx ry rz,
    along and about the axes of the tip. tolerance: largest error [m and rad] of what must be met.
    """
    goal, start = np.asarray(T_base_tip, dtype=float), np.asarray(starts, dtype=float)
    shape = np.broadcast_shapes(goal.shape[:-2], start.shape[:-1])
    goal = np.broadcast_to(goal, (*shape, 4, 4)).reshape(-1, 4, 4)
    q = np.clip(np.broadcast_to(start, (*shape, chain.n)).reshape(-1, chain.n), chain.lower, chain.upper)
    q = chain.followed(q)
    wanted = np.flatnonzero(np.asarray(mask, dtype=bool))
    q, error = _descend(chain, goal, q, wanted, tolerance)
    out = np.zeros((len(q), 6))
    out[:, wanted] = error[:, wanted]
    met = np.abs(out).max(axis=1, initial=0.0) <= tolerance
    return InverseResult(q.reshape(*shape, chain.n), out.reshape(*shape, 6), met.reshape(shape))


def _descend(chain: Chain, goal: Array, q: Array, wanted: np.ndarray, tolerance: float) -> tuple[Array, Array]:
    """Postures (N, n) that the steps from q end in, and the errors (N, 6) there."""
    q = q.copy()
    e, J = _linearised(chain, goal, q)
    cost = np.sum(e[:, wanted] ** 2, axis=1)
    damping = DAMPING * cost + 1e-14
    refused = np.zeros(len(q), int)
    alive = np.abs(e[:, wanted]).max(axis=1, initial=0.0) > tolerance
    for _ in range(_MAX_STEPS):
        rows = np.flatnonzero(alive)
        if not len(rows):
            break
        A, r = J[rows][:, wanted], e[rows][:, wanted]
        new = chain.followed(q[rows] + _steps(chain, q[rows], A, r, damping[rows]))
        e_new, J_new = _linearised(chain, goal[rows], new)
        cost_new = np.sum(e_new[:, wanted] ** 2, axis=1)
        better = cost_new < cost[rows]
        stalled = better & (cost_new > 0.9999 * cost[rows])
        good, bad = rows[better], rows[~better]
        q[good], e[good], J[good], cost[good] = new[better], e_new[better], J_new[better], cost_new[better]
        damping[good], refused[good] = DAMPING * cost[good] + 1e-14, 0
        damping[bad], refused[bad] = np.maximum(30.0 * damping[bad], 1e-6), refused[bad] + 1
        arrived = np.abs(e[rows][:, wanted]).max(axis=1, initial=0.0) <= tolerance
        alive[rows[arrived | stalled | (refused[rows] >= _MAX_REFUSED)]] = False
    return q, e


def _linearised(chain: Chain, goal: Array, q: Array) -> tuple[Array, Array]:
    """Errors (N, 6) seen from the tips, and what they lose per unit of each joint, (N, 6, n)."""
    f = frames(chain, q)
    v, w = tip_motions(chain, f)
    e = se3.error(f.transform(-1), goal)
    J = np.empty((len(q), 6, chain.n))
    J[:, :3] = np.swapaxes(v - crossed_rows(e[:, None, :3], w), 1, 2)
    J[:, 3:] = so3.left_jacobian_inverse(e[:, 3:]) @ np.swapaxes(w, 1, 2)
    return e, chain.by_leaders(J)


def _steps(chain: Chain, q: Array, A: Array, r: Array, damping: Array) -> Array:
    """Damped steps (N, n) within the limits: joints they would push out are held there, and the rest is done again."""
    free = np.ones(q.shape, bool)
    step = np.zeros_like(q)
    todo = np.arange(len(q))
    eye = np.eye(A.shape[1])
    for _ in range(chain.n):
        B = A[todo] * free[todo, None]
        Bt = np.swapaxes(B, 1, 2)
        solved = np.linalg.solve(B @ Bt + damping[todo, None, None] * eye, r[todo, :, None])
        s = (Bt @ solved)[..., 0]
        s *= np.minimum(1.0, LONGEST / np.maximum(np.abs(s).max(axis=1, keepdims=True), 1e-300))
        step[todo] = s
        at, new = q[todo], q[todo] + s
        held = free[todo] & (((new < chain.lower) & (at <= chain.lower)) | ((new > chain.upper) & (at >= chain.upper)))
        free[todo] &= ~held
        todo = todo[held.any(axis=1)]
        if not len(todo):
            break
    return np.clip(q + step, chain.lower, chain.upper) - q


Mechanism: TypeAlias = Chain | Delta
_STEP, _SLID = 0.1, 0.02  # rad, m; on a way that is looked at


def is_serial_arm(robot: Mechanism) -> TypeGuard[Chain]:
    """Whether the robot is a serial chain: what is known of such only, asks here and passes over others."""
    return isinstance(robot, Chain)


def is_delta(robot: object) -> TypeGuard[Delta]:
    """Whether the robot is a Delta, for what only its parallelograms have."""
    return isinstance(robot, Delta)


def forward(robot: Mechanism, q: ArrayLike) -> Array:
    """Tip poses T_base_tip (..., 4, 4) [m] at postures q (..., n) [rad, m]. Raises NotReachable where none is."""
    return delta_kinematics.forward(robot, q) if isinstance(robot, Delta) else kinematics.chain_forward(robot, q)


def tool_frames(robot: Mechanism, T_tip_tool: Array, q: ArrayLike, twists: Mapping[int, Array] | None = None) -> Frames:
    """Frames of every place up to the tool (4, 4) in the tip, seen from the root, at postures q (N, n); NaN where a
    Delta cannot be there. twists: small motions (6, N) [m, rad] put in at places, each in the frame of its place.
    """
    if isinstance(robot, Delta):
        return delta_kinematics.frames(robot, q, twists, T_tip_tool)
    return kinematics.frames(robot.from_root_to(T_tip_tool), q, twists)


def payload_wrench(robot: Mechanism, q: Array, down: Array = bodies.DOWN, held: HeldBehind | None = None) -> Array:
    """Weight of 1 kg at the tip as every joint bears it, (n, 6, N), as in :mod:`modcal_core.robots.bodies`."""
    if isinstance(robot, Delta):
        return delta_kinematics.payload_wrench(robot, q, bodies.STANDARD_GRAVITY)
    return bodies.payload_wrench(robot, q, down, held)


def offset_wrench(robot: Mechanism, q: Array, down: Array = bodies.DOWN, held: HeldBehind | None = None) -> Array:
    """How that changes with each metre of its offset from the tip, (3, n, 6, N); unknown of a Delta, and zero."""
    if isinstance(robot, Delta):
        return np.zeros((3, robot.n, 6, len(np.asarray(q))))
    return bodies.offset_wrench(robot, q, down, held)


def gravity_wrench(robot: Mechanism, inertias: Inertias, q: ArrayLike, moved: Array | None = None) -> Array:
    """Weight of the links beyond each joint, (n, 6, N), as there; unknown of a Delta, and zero."""
    if isinstance(robot, Delta):
        return np.zeros((robot.n, 6, len(np.asarray(q))))
    return bodies.chain_gravity_wrench(robot, inertias, np.asarray(q, dtype=float), moved)


def takes(robot: Mechanism, q: Array) -> np.ndarray:
    """Which postures (N, n) the robot can take, apart from its limits, (N,): a Delta's platform must fit its arms."""
    return delta_kinematics.reachable(robot, q) if isinstance(robot, Delta) else np.ones(len(q), dtype=bool)


def passable(robot: Mechanism, start: Array, end: Array) -> bool:
    """Whether a robot can go straight from one posture (n,) to another: a Delta's platform must fit all the way."""
    if not robot.closed:
        return True
    steps = max(int(np.ceil((np.abs(end - start) / np.where(robot.revolute, _STEP, _SLID)).max())), 1)
    between = start + np.linspace(0.0, 1.0, steps + 1)[:, None] * (end - start)
    return bool(takes(robot, between).all())


def joint_ranges(robot: Mechanism) -> tuple[Array, Array]:
    """Least and largest joint positions (n,) [rad, m]: the limits; a full turn, or ±0.5 m, where there is none."""
    return ranges(robot.revolute, robot.lower, robot.upper)


def random_postures(robot: Mechanism, count: int, rng: np.random.Generator) -> Array:
    """Joint positions (count, n), uniform within :func:`joint_ranges`; of a Delta, such as its platform can take."""
    low, high = joint_ranges(robot)
    if is_serial_arm(robot):
        return robot.followed(rng.uniform(low, high, (count, robot.n)))
    found = np.empty((0, robot.n))
    for _ in range(1000):
        q = rng.uniform(low, high, (4 * count, robot.n))
        found = np.concatenate([found, q[takes(robot, q)]])
        if len(found) >= count:
            break
    return found[:count]

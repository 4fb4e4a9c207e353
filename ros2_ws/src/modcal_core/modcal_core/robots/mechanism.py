"""What calibration asks of a robot, whatever it is built like: a serial chain or a Delta.

Both offer joints ``names`` with limits at places ``first_place`` …, a tool at ``tool_place``, between a base and a tip
link, and ways to change them. The functions here are those whose formulas differ and that need kinematics.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias, TypeGuard

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.geometry import Array
from modcal_core.robots import bodies, delta_kinematics, kinematics
from modcal_core.robots.chain import Chain, Follower, ranges
from modcal_core.robots.delta import Delta
from modcal_core.robots.kinematics import Frames
from modcal_core.robots.urdf_inertias import HeldBehind, Inertias

Mechanism: TypeAlias = Chain | Delta
_STEP, _SLID = 0.1, 0.02  # rad, m; on a way that is looked at


def is_serial_arm(robot: Mechanism) -> TypeGuard[Chain]:
    """Whether the robot is a serial chain: what is known of such only, asks here and passes over others."""
    return isinstance(robot, Chain)


def followers_of(robot: Mechanism) -> tuple[Follower, ...]:
    """Its joints that mimic another one."""
    return robot.follows if is_serial_arm(robot) else ()


def is_delta(robot: object) -> TypeGuard[Delta]:
    """Whether the robot is a Delta, for what only its parallelograms have."""
    return isinstance(robot, Delta)


def forward(robot: Mechanism, q: ArrayLike) -> Array:
    """Tip poses T_base_tip (..., 4, 4) for joint positions q (..., n) [rad, m].

    Raises NotReachable for postures that a Delta cannot take.
    """
    return delta_kinematics.forward(robot, q) if isinstance(robot, Delta) else kinematics.chain_forward(robot, q)


def tool_frames(robot: Mechanism, T_tip_tool: Array, q: ArrayLike, twists: Mapping[int, Array] | None = None) -> Frames:
    """Frames of every place up to the tool, seen from the root, for joint positions q (N, n) [rad, m].

    T_tip_tool: (4, 4) [m]. twists: small motions (6, N) [m, rad] put in at places, each in the frame of its place.
    Postures that a Delta cannot take are NaN.
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
    """How the weight of 1 kg as every joint bears it changes with its offset from the tip, (3, n, 6, N), as in
    :mod:`modcal_core.robots.bodies`; of a Delta nothing is known of it, and it is zero.
    """
    if isinstance(robot, Delta):
        return np.zeros((3, robot.n, 6, len(np.asarray(q))))
    return bodies.offset_wrench(robot, q, down, held)


def gravity_wrench(robot: Mechanism, inertias: Inertias, q: ArrayLike, moved: Array | None = None) -> Array:
    """Weight of the links beyond each joint, (n, 6, N), as in :mod:`modcal_core.robots.bodies`; of a Delta nothing is
    known of it, and it is zero.
    """
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
    """Joint positions (count, n), uniform within the limits; a full turn, or ±0.5 m, where there is none.

    Of a Delta, only postures that its platform can take.
    """
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

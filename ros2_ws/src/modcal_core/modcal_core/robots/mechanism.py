"""What calibration asks of a robot, whether it is a serial chain or a Delta.

Both have names, limits, a base and a tip, joints at places ``first_place`` … and a tool at ``tool_place``; the
functions here are the ones whose formulas differ.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.robots import delta_kinematics, gravity, kinematics
from modcal_core.robots.chain import Chain
from modcal_core.robots.delta import Delta
from modcal_core.robots.kinematics import Frames

Mechanism = Chain | Delta
_STEP = 0.1  # rad, on a way that is looked at


def forward(robot: Mechanism, q: ArrayLike) -> Array:
    """Tip poses T_base_tip (..., 4, 4) for joint positions q (..., n) [rad, m].

    Raises NotReachable for postures that a Delta cannot take.
    """
    return kinematics.forward(robot, q) if isinstance(robot, Chain) else delta_kinematics.forward(robot, q)


def tool_frames(robot: Mechanism, T_tip_tool: Array, q: ArrayLike, twists: Mapping[int, Array] | None = None) -> Frames:
    """Frames of every place up to the tool, seen from the root, for joint positions q (N, n) [rad, m].

    T_tip_tool: (4, 4) [m]. twists: small motions (6, N) [m, rad] put in at places, each in the frame of its place.
    Postures that a Delta cannot take are NaN.
    """
    if isinstance(robot, Delta):
        return delta_kinematics.frames(robot, q, twists, T_tip_tool)
    rooted = np.array(robot.origins)
    rooted[0] = se3.inverse(se3.transform(robot.joint_basis[0]))
    rooted[-1] = rooted[-1] @ T_tip_tool
    return kinematics.frames(robot.with_origins(rooted), q, twists)


def payload_wrench(robot: Mechanism, q: Array) -> Array:
    """Weight of 1 kg at the tip as every joint bears it, (n, 6, N), as in :mod:`modcal_core.robots.gravity`."""
    if isinstance(robot, Delta):
        return delta_kinematics.payload_wrench(robot, q, gravity.STANDARD_GRAVITY)
    return gravity.payload_wrench(robot, q)


def passable(robot: Mechanism, start: Array, end: Array) -> bool:
    """Whether a robot can go straight from one posture (n,) to another: a Delta's platform must fit all the way."""
    if isinstance(robot, Chain):
        return True
    steps = max(int(np.ceil(np.abs(end - start).max() / _STEP)), 1)
    between = start + np.linspace(0.0, 1.0, steps + 1)[:, None] * (end - start)
    return bool(delta_kinematics.reachable(robot, between).all())


def random_postures(robot: Mechanism, count: int, rng: np.random.Generator) -> Array:
    """Joint positions (count, n), uniform within the limits; a full turn, or ±0.5 m, where there is none.

    Of a Delta, only postures that its platform can take.
    """
    span = np.where(robot.revolute, np.pi, 0.5)
    low = np.where(np.isfinite(robot.lower), robot.lower, -span)
    high = np.where(np.isfinite(robot.upper), robot.upper, span)
    if isinstance(robot, Chain):
        return rng.uniform(low, high, (count, robot.n))
    found = np.empty((0, robot.n))
    for _ in range(1000):
        q = rng.uniform(low, high, (4 * count, robot.n))
        found = np.concatenate([found, q[delta_kinematics.reachable(robot, q)]])
        if len(found) >= count:
            break
    return found[:count]

"""Ways to pull at furniture without learning how it moves, or after learning it wrong: what modcal is compared with.

They share no code with modcal's own way to pull, and run in this process as fast as MuJoCo does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from modcal_core.errors import ModcalError
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.mechanism import inverse
from modcal_nodes.simulation.furniture import Furniture
from modcal_nodes.simulation.pulling import Pulling

PERIOD = 0.004  # s
SPEED = 0.06  # m/s of the handle
_TARE_S = 0.2
_FARTHEST = 1.15  # of the way that should do; a compliant hand lags behind
_PATIENCE = 1.3  # times what that way should take
_MASS, _STIFFNESS, _DAMPING = (np.repeat(pair, 3) for pair in ([10.0, 1.0], [300.0, 20.0], [1000.0, 200.0]))
Way = Callable[[float], Array]


@dataclass(frozen=True)
class Pull:
    """What came of one pull. peak, mean: of the true force between hand and handle [N]. opened, goal [rad; m]."""

    peak: float
    mean: float
    opened: float
    goal: float
    said: str = ""

    @property
    def done(self) -> bool:
        """Whether it is as open as it was to be, to one part in a hundred."""
        return self.opened >= 0.99 * self.goal


def straight(scene: Furniture) -> Way:
    """The tool's pose (4, 4) after a distance [m]: straight back, which is all that a hand knows that holds a handle."""
    return lambda s: se3.transform(np.eye(3), -s * scene.T_base_handle[:3, 2]) @ scene.T_base_handle


def learnt_wrong(scene: Furniture) -> Way:
    """The same along a door whose radius is taken 5 % too large, or a drawer whose direction is 3° off."""
    if not scene.turns:
        across = np.cross(scene.axis, [0.0, 0.0, 1.0])
        off = so3.exp(np.radians(3.0) * across / np.linalg.norm(across)) @ scene.axis
        return lambda s: se3.transform(np.eye(3), s * off) @ scene.T_base_handle
    arm = scene.T_base_handle[:3, 3] - scene.point
    arm -= scene.axis * (scene.axis @ arm)
    point = scene.point - 0.05 * arm
    twist = np.concatenate([np.cross(point, scene.axis) + scene.pitch * scene.axis, scene.axis])
    return lambda s: se3.exp(twist * s / (1.05 * scene.radius)) @ scene.T_base_handle


def pull(world: Pulling, way: Way, compliant: bool) -> Pull:
    """Follow a way at 6 cm/s until the object is open, stiffly or with an admittance about it."""
    scene = world.scene
    length = scene.goal * (scene.radius if scene.turns else 1.0)
    tare = np.mean([_felt(world) for _ in range(round(_TARE_S / PERIOD))], axis=0)
    world.forget()
    q, x, v, opened = world.reference(), np.zeros(6), np.zeros(6), 0.0
    for tick in range(round(_PATIENCE * length / SPEED / PERIOD)):
        T = way(min(_FARTHEST * length, tick * PERIOD * SPEED))
        if compliant:
            tool = world.tool()[:3, :3]
            wrench = _felt(world, 0.0) - tare
            force = np.concatenate([tool @ wrench[:3], tool @ wrench[3:]])
            v = (v + PERIOD / _MASS * (force - _STIFFNESS * x)) / (
                1.0 + PERIOD * _DAMPING / _MASS + PERIOD**2 * _STIFFNESS / _MASS
            )
            x = x + PERIOD * v
            T = se3.transform(so3.exp(x[3:]) @ T[:3, :3], T[:3, 3] + x[:3])
        try:
            q = inverse(world.chain, T, q, restarts=0, tolerance=1e-6)
            world.refer(q)
        except ModcalError as error:
            return _outcome(world, opened, str(error))
        world.advance(PERIOD)
        opened = max(opened, world.opened)
        if opened >= world.scene.goal:
            break
    return _outcome(world, opened, "")


def _felt(world: Pulling, wait: float = PERIOD) -> Array:
    world.advance(wait)
    return world.wrench()


def _outcome(world: Pulling, opened: float, said: str) -> Pull:
    return Pull(float(np.linalg.norm(world.peak()[:3])), world.mean(), opened, world.scene.goal, said)

"""What joint states say of the joints' efforts, in the ways in which drivers of real arms say it."""

from __future__ import annotations

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_nodes.simulation.pulling import Pulling, effort_limits

KINDS = ("torques", "friction", "currents", "weightless", "motors")
_BEARINGS = 0.06  # of the full effort: dry friction of a gear between what measures and the joint
_MOVES = 1e-3  # rad/s at which that is overcome


class ReportedEfforts:
    """Called for the efforts (n,) of now, of one of these kinds:

    * torques: sensors behind the gear, whose gains are off by up to 2 %, their zeros by 0.4 N m (wrist: 0.1), with noise;
    * friction: of the motors, before gears that take some of it one way or the other, as they were moved last;
    * currents: [A], of motors and gears that make 10 N m of one;
    * motors: torque constants that are off by 5 %, one way or the other, with noise; the joints' friction is the world's;
    * weightless: without what the arm's own weight takes.
    """

    def __init__(self, kind: str, urdf: str, world: Pulling, rng: np.random.Generator) -> None:
        assert kind in KINDS, kind
        self._kind, self._world, self._rng = kind, world, rng
        full = effort_limits(urdf, world.chain.names)
        size = np.where(full < 20.0, 0.25, 1.0)
        self._gain = 1.0 + rng.uniform(-0.02, 0.02, len(full))
        self._zero, self._noise = 0.4 * size * rng.uniform(-1.0, 1.0, len(full)), 0.1 * size
        if kind == "motors":
            self._gain, self._zero = 1.0 + 0.05 * rng.choice([-1.0, 1.0], len(full)), np.zeros(len(full))
        self._dry = _BEARINGS * full
        self._held = self._dry * rng.uniform(-1.0, 1.0, len(full))

    def __call__(self) -> Array:
        """At this moment [N m; N; A]."""
        world = self._world
        true = world.efforts()
        said = self._gain * true + self._zero + self._noise * self._rng.standard_normal(len(true))
        if self._kind in ("torques", "motors"):
            return said
        if self._kind == "weightless":
            return said - world.weight()
        moves = np.tanh(world.joints()[1] / _MOVES)
        self._held = np.where(np.abs(moves) > 0.5, self._dry * moves, self._held)
        return said + self._held if self._kind == "friction" else 0.1 * said

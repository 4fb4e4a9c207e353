"""A force sensor that is stuck, in MuJoCo: what is locked is let go before the servos tear at it.

The core's operation and tracker beside the physics, in this process; some seconds a pull.
"""

from __future__ import annotations

import numpy as np
import pytest
from nodes.own_pull import pull
from nodes.plain_pulls import Pull
from nodes.pulling import PANDA

from modcal_core.geometry.so3 import Array
from modcal_core.robots.urdf import read_chain
from modcal_nodes.simulation.furniture import draw
from modcal_nodes.simulation.pulling import Pulling

URDF = PANDA.read_text()
CHAIN = read_chain(URDF)


class Stuck:
    """Says what is so until a force [N] beyond the first readings is felt, and that for ever after."""

    def __init__(self, force: float) -> None:
        self._force, self._first, self._last = force, None, None

    def __call__(self, w: Array) -> Array:
        self._first = w if self._first is None else self._first
        if self._last is None and np.linalg.norm(w[:3] - self._first[:3]) > self._force:
            self._last = w
        return w if self._last is None else self._last


def pulled(sensed: Stuck, stiffness: float, **chosen: object) -> tuple[Pull, float]:
    """A pull at a door or drawer, and the force that is left in the hand [N]. stiffness: that is stated [N/m]."""
    scene = draw(CHAIN, np.random.default_rng(1), chosen)
    world = Pulling.of(URDF, CHAIN, scene, np.random.default_rng(1))
    done = pull(world, URDF, sensed, contact_stiffness_n_m=stiffness)
    for _ in range(50):  # as the arm stands where it was sent last
        world.forget()
        world.advance(0.004)
    return done, float(np.linalg.norm(world.peak()[:3]))


@pytest.mark.slow
@pytest.mark.parametrize("force", [3.0, 12.0])
@pytest.mark.parametrize(("kind", "grasp", "stiffness"), [("door", "weld", 15e3), ("drawer", "ball", 45e3)])
def test_what_is_locked_is_let_go_below_60_n_by_a_sensor_that_is_stuck(
    kind: str, grasp: str, stiffness: float, force: float
) -> None:
    """The drawer is pulled along the outstretched arm, whose servos are three times as stiff there; that is stated."""
    done, left = pulled(Stuck(force), stiffness, kind=kind, grasp=grasp, stop=0.0)
    assert "the setpoint leads the tool" in done.said, done.said
    assert done.peak < 60.0
    assert left < 10.0
    assert not done.done

"""A heavy door with a closer, held like a ball, in MuJoCo: opened by not much more than it takes.

The core's operation and tracker beside the physics, in this process; a quarter of a minute a pull.
"""

from __future__ import annotations

import numpy as np
import pytest
from nodes.own_pull import pull
from nodes.pulling import PANDA

from modcal_core.robots.urdf import read_chain
from modcal_nodes.simulation.furniture import draw
from modcal_nodes.simulation.pulling import Pulling

URDF = PANDA.read_text()
CHAIN = read_chain(URDF)


@pytest.mark.slow
def test_a_door_with_a_closer_is_opened_by_a_hand_that_does_not_turn_with_it() -> None:
    """The way turns by 60° as the hand sees it. Where the hand's gains stay as they were, it comes to pull beside the
    way: 50 N are felt after 25° then, of a closer that takes 34.
    """
    closer = {"kind": "door", "spring": 0.0, "friction": 0.5, "mass_kg": 40.0, "resistance": "closer 32"}
    scene = draw(CHAIN, np.random.default_rng(2004), {**closer, "grasp": "ball"})
    done = pull(Pulling.of(URDF, CHAIN, scene, np.random.default_rng(0)), URDF)
    assert done.done, done.said
    assert done.peak < 45.0

"""Furniture that is hard to open, in MuJoCo: by no more force than was stated, and let go where that does not do.

The core's operation and tracker beside the physics, in this process; some seconds a pull. ``make bench NAME=doors`` has all.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from nodes.own_pull import pull
from nodes.plain_pulls import Pull
from nodes.pulling import PANDA

from modcal_core.errors import BadTable
from modcal_core.robots.urdf import read_chain
from modcal_nodes.simulation.furniture import KNOWN, Furniture, draw, resistance
from modcal_nodes.simulation.pulling import Pulling

URDF = PANDA.read_text()
CHAIN = read_chain(URDF)


@cache
def door(seed: int, **chosen: object) -> Furniture:
    return draw(CHAIN, np.random.default_rng(seed), {"kind": "door", "spring": 0.0, **chosen})


def pulled(seed: int, stated: float = 50.0, **chosen: object) -> Pull:
    scene = door(seed, friction=0.5, mass_kg=40.0, **chosen)
    return pull(Pulling.of(URDF, CHAIN, scene, np.random.default_rng(seed)), URDF, max_force_n=stated)


@pytest.mark.slow
def test_a_heavy_door_with_a_closer_held_by_a_ball_is_opened() -> None:
    """The hand turns by a tenth of what the door does: together they look like a circle of three metres."""
    done = pulled(1000, grasp="ball", resistance="closer 10")
    assert done.done, done
    assert done.peak < 25.0


@pytest.mark.slow
def test_what_is_stated_is_the_one_number_that_decides_how_hard_is_pulled() -> None:
    """A gasket that takes 31 N: not with 25, but with 80."""
    gentle, firm = (pulled(1013, stated, grasp="weld", resistance="gasket 30") for stated in (25.0, 80.0))
    assert not gentle.done
    assert "does not move" in gentle.said
    assert gentle.peak < 1.2 * 25.0
    assert firm.done, firm
    assert firm.peak < 80.0


@pytest.mark.parametrize("name", list(KNOWN))
def test_a_law_is_as_large_as_it_says(name: str) -> None:
    """Pulled slowly, over a third of a metre."""
    law = resistance(f"{name} 20")
    assert law is not None
    assert max(law.force(s, 5e-3) for s in np.linspace(0.0, 0.35, 701)) == pytest.approx(20.0, rel=0.15)


def test_a_closer_closes_and_friction_only_resists() -> None:
    back = {name: resistance(f"{name} 20").force(0.05, -0.1) for name in ("closer", "stick_slip")}  # type: ignore[union-attr]
    assert back["closer"] > 10.0
    assert back["stick_slip"] < 0.0


@pytest.mark.parametrize("text", ["closer", "closer much", "closer -3", "closer nan", "glue 20"])
def test_a_law_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(BadTable, match="resistance"):
        resistance(text)

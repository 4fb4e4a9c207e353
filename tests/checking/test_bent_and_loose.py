"""Changes that no joint's zero, gear or load explains: a bent link, a tool that is loose on its flange."""

from __future__ import annotations

import numpy as np
import pytest
from cells import Recorded, ur10
from checking.checks import Poses, checked, names, rms

from modcal_core.calibration.store import Calibration
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.robots import forward
from modcal_nodes.simulation.world import World

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(("link", "bend"), [(2, (0, 0, 0, 0, 3e-3, 0)), (3, (5e-4, 0, 0, 2e-3, 0, 2e-3))])
def test_a_bent_link_is_no_scatter(cell: tuple[Recorded, Calibration], link: int, bend: tuple[float, ...]) -> None:
    straight, origins = ur10(), ur10().origins.copy()
    origins[link] = origins[link] @ se3.exp(np.array(bend))
    arms = [World(arm, np.random.default_rng(0), 0.0, 0.0) for arm in (straight.with_origins(origins), straight)]
    root = cell[0].world.T_tracker_base

    def seen(q: Array, world: Poses) -> Array:
        bent, before = (arm.tool_in_tracker(q) for arm in arms)
        return root @ bent @ se3.inverse(before) @ se3.inverse(root) @ world(q)

    for count in (10, 16):
        found, _, _ = checked(cell, seen, count=count)
        assert names(found) == {("link", ur10().names[link])}, found.sentence
        assert found.repaired is not None
        fresh = np.random.default_rng(7).uniform(-2.5, 2.5, (100, 6))
        truth = seen(fresh, cell[0].world.tool_in_tracker)
        assert rms(found.repaired.predict(fresh), truth) < 0.2 * rms(cell[1].predict(fresh), truth)


def test_a_loose_tool_is_named(cell: tuple[Recorded, Calibration]) -> None:
    """It rests on one side or the other, by whether its weight turns the second wrist joint forwards or backwards."""
    play, little = np.array([3e-4, 0.0, 0.0, 0.0, 1e-3, 5e-4]), 1e-4 * np.eye(6)[4]

    def seen(q: Array, world: Poses) -> Array:
        rise = forward(ur10(), q + little)[:, 2, 3] - forward(ur10(), q - little)[:, 2, 3]
        return world(q) @ se3.exp(np.sign(rise)[:, None] * play)

    for count in (10, 16):
        found, _, _ = checked(cell, seen, count=count)
        assert names(found) == {("tool_play", "tool")}, found.sentence
        assert "loose" in found.sentence

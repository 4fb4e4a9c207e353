"""Furniture opened through the real nodes: gently, to the goal, or not at all.

Up to 20 s each, at the pace of the physics: nowhere else are forces felt through both nodes and DDS.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nodes.pulling import PANDA, Opening, open_it

from modcal_core.robots.urdf import read_chain
from modcal_nodes.simulation.furniture import draw

CHAIN = read_chain(PANDA.read_text())
# simulated time, which waits for the next setpoint: the physics must not depend on what else the machine is doing
PACED = {"publish_clock": True, "keep_step": True, "clock_rate_hz": 250.0}

pytestmark = pytest.mark.dds


def opened(folder: Path, seed: int, share: float = 0.35, by: str = "sensor", **chosen: Any) -> Opening:
    scene = draw(CHAIN, np.random.default_rng(seed), chosen)
    # a third of the way that bench/doors goes: by then the model is known and followed at full speed
    opening = open_it(folder, scene, {"seed": seed, **chosen, **PACED}, patience=150.0, share=share, wrench=by)
    print(f"{scene.kind}, {scene.grasp}, radius {scene.radius:.2f} m, {opening.seconds:.1f} s: {opening.pull}")
    return opening


@pytest.mark.slow
def test_a_drawer_that_jams_is_felt_below_the_limit_and_let_go(tmp_path: Path) -> None:
    """At a hard stop, half way and at full speed; up to there it opens gently."""
    # the goal, 0.15 m, lies beyond the stop
    opening = opened(tmp_path, 1, share=0.5, kind="drawer", grasp="weld", stop=0.12, publish_effort=True)
    assert not opening.pull.done
    assert opening.pull.opened == pytest.approx(0.12, abs=2e-3)
    met = opening.opened[np.argmax(opening.opened[:, 1] > 0.115), 0]
    before = opening.forces[opening.forces[:, 0] < met, 1]
    assert before.max() <= 40.0
    assert before.mean() <= 12.0
    assert 15.0 < opening.pull.peak < 60.0
    assert opening.forces[-10:, 1].mean() < 0.5 * opening.pull.peak
    # the joints' efforts told of it as well, and of no more
    shown = [float(newtons) for newtons in opening.by_efforts]
    assert 15.0 < max(shown) < opening.pull.peak + 2.0


@pytest.mark.slow
def test_a_drawer_is_opened_by_the_efforts_of_the_joints_without_a_force_sensor(tmp_path: Path) -> None:
    """What the joints bear by themselves is learned as the hand comes to the handle."""
    opening = opened(
        tmp_path, 1, by="efforts", share=0.5, kind="drawer", grasp="weld", publish_effort=True, approach_s=6.0
    )
    assert opening.pull.done
    assert opening.pull.peak <= 40.0

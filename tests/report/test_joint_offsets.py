"""Joint offsets: what was put into an arm is found, whatever base and tool are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import samples_of, ur10
from scipy.stats import chi2

from modcal_core.calibration.model import place_model
from modcal_core.geometry import se3, so3
from modcal_core.loop import calibrate
from modcal_core.report.joint_offsets import JointOffset, joint_offsets
from modcal_nodes.simulation.world import World

OFFSETS = np.radians([0.3, -0.2, 0.15, 0.1, -0.05, 0.4])


@pytest.mark.parametrize("kind", ["pose", "point"])
def test_offsets_that_were_put_in_are_found(kind: str) -> None:
    """The first and the last joint's are turns of base and tool, and a point of the tool shows no turn of it."""
    chain = ur10()
    turned = se3.transform(so3.exp(np.c_[np.zeros((6, 2)), OFFSETS]))
    origins = np.array(chain.origins)
    origins[:-1] = origins[:-1] @ turned
    start = place_model(chain, ("tracker",))
    T_tip_tool = se3.exp([0.05, 0.03, 0.12, 0.4, -0.3, 0.2])
    base = se3.exp([1.0, -2.0, 0.3, 0.5, 0.1, -1.0])[None]
    model = replace(start, chain=chain.with_origins(origins), T_tip_tool=T_tip_tool, T_frame_base=base)
    q = np.random.default_rng(1).uniform(-2.5, 2.5, (60, 6))
    found = joint_offsets(model, samples_of(chain, q, model.predict(q), kind))
    assert found is not None
    assert [o.joint for o in found.found] == list(chain.names[1:5])
    assert [o.value for o in found.found] == pytest.approx(OFFSETS[1:5], abs=4e-5)
    assert all(o.turning and o.std is None for o in found.found)
    assert found.left_mm < 0.01 * found.nominal_mm


def test_an_arm_that_is_nominal_has_none() -> None:
    model = place_model(ur10(), ("tracker",))
    q = np.random.default_rng(1).uniform(-2.5, 2.5, (20, 6))
    found = joint_offsets(model, samples_of(ur10(), q, model.predict(q)))
    assert found is not None
    assert [o.value for o in found.found] == pytest.approx([0.0] * 4, abs=1e-10)


@pytest.mark.parametrize("kind", ["pose", "point"])
def test_intervals_hold_what_they_say(kind: str) -> None:
    """Offsets of the true arm, in recordings that differ by their noise alone: 95 % of the intervals hold them."""
    chain, rng = ur10(), np.random.default_rng(7)
    world = World(
        chain, rng, 5e-4, 1e-3, se3.exp([1.0, 0.2, 0.1, 0.3, 0.2, -1.0]), se3.exp([0.05, 0.03, 0.12, 0, 0, 0])
    )
    q = rng.uniform(-2.5, 2.5, (60, 6))
    exact = world.tool_in_tracker(q)

    def offsets(size: float) -> tuple[JointOffset, ...]:
        T = exact.copy()
        T[:, :3, 3] += size * rng.standard_normal((60, 3))
        T[:, :3, :3] = T[:, :3, :3] @ so3.exp(size * rng.standard_normal((60, 3)))
        found = calibrate(samples_of(chain, q, T, kind), chain, np.random.default_rng(0), look_for_effects=False)
        assert found.report.offsets is not None
        return found.report.offsets.found

    truth = [o.value for o in offsets(1e-8)]
    drawn = [offsets(5e-5) for _ in range(12)]
    z = [(o.value - true) / (o.std or np.nan) for run in drawn for o, true in zip(run, truth, strict=True)]
    assert len(z) == 12 * 4
    # the four of a run may hang together as one would: then their squares add up to 4 times a chi square of 12
    low, high = 4.0 * chi2.ppf([0.001, 0.999], 12)
    assert low < np.sum(np.square(z)) < high

"""Joint offsets: what was put into an arm is found, whatever base and tool are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, samples_of, ur10
from scipy.stats import chi2

from modcal_core.calibration.model import place_model
from modcal_core.evaluation import evaluate
from modcal_core.geometry import se3, so3
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.outcome.joint_offsets import joint_offsets
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
    found = joint_offsets(model, q, kind == "pose")
    assert found is not None
    assert [o.joint for o in found.found] == list(chain.names[1:5])
    assert [o.value for o in found.found] == pytest.approx(OFFSETS[1:5], abs=4e-5)
    assert all(o.turning and o.std is None for o in found.found)
    assert found.left_mm < 0.01 * found.nominal_mm


def test_an_arm_that_is_nominal_has_none() -> None:
    model = place_model(ur10(), ("tracker",))
    q = np.random.default_rng(1).uniform(-2.5, 2.5, (20, 6))
    found = joint_offsets(model, q, True)
    assert found is not None
    assert [o.value for o in found.found] == pytest.approx([0.0] * 4, abs=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pose", "point"])
def test_intervals_hold_what_they_say(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Recordings of one arm in MuJoCo that differ by postures and noise; the truth is that of thousands of postures."""
    chain, count, runs = ur10(), 60, 8
    frame, tool = se3.exp([1.0, 0.2, 0.1, 0.3, 0.2, -1.0]), se3.exp([0.05, 0.03, 0.12, 0, 0, 0])
    world = World(chain, np.random.default_rng(7), 5e-4, 1e-3, frame, tool)
    moved = np.random.default_rng(7).standard_normal((7, 6)) * ([5e-4] * 3 + [1e-3] * 3)
    start = place_model(chain, ("tracker",))
    true = replace(start, chain=chain.with_origins(chain.origins @ se3.exp(moved)), T_tip_tool=tool)
    rng = np.random.default_rng(8)

    def recording(n: int) -> Samples:
        q = rng.uniform(-2.5, 2.5, (n, 6))
        T = world.tool_in_tracker(q)
        T[:, :3, 3] += 3e-4 * rng.standard_normal((n, 3))
        T[:, :3, :3] = T[:, :3, :3] @ so3.exp(3e-4 * rng.standard_normal((n, 3)))
        return samples_of(chain, q, T, kind)

    drawn = []
    for _ in range(runs):
        made = calibrate(recording(count), chain, np.random.default_rng(0), look_for_effects=False)
        assert made.report.offsets is not None
        drawn.append(made.report.offsets.found)
    monkeypatch.setattr("modcal_core.outcome.joint_offsets._MAX", 4000)
    whole = joint_offsets(true, rng.uniform(-2.5, 2.5, (4000, 6)), kind == "pose")
    assert whole is not None
    z = [(o.value - t.value) / (o.std or np.nan) for run in drawn for o, t in zip(run, whole.found, strict=True)]
    assert len(z) == runs * 4
    # the four of a run may hang together as one would: then their squares add up to 4 times a chi square of so many
    low, high = 4.0 * chi2.ppf([0.001, 0.999], runs)
    assert low < np.sum(np.square(z)) < high
    # and a few postures are no better than they are: the interval is that of a recording, not of the noise alone
    assert np.std([o[0].value for o in drawn]) == pytest.approx(np.mean([o[0].std for o in drawn]), rel=1.0)


@pytest.mark.slow
def test_an_evaluation_has_the_offsets_of_its_calibration() -> None:
    made = record(4, 60, "point")
    found = calibrate(made.samples, ur10(), np.random.default_rng(0), look_for_effects=False)
    other = evaluate(found.calibration, record(9, 40, "point").samples, np.random.default_rng(0), refit_base=True)
    assert other.offsets == found.report.offsets is not None

"""Two instruments of one arm: where one is longer, or sees another target, no function of the posture tells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import samples_of, ur10

from modcal_core.errors import BadRecording
from modcal_core.geometry import se3
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.verdict.predictable import MAX_PREDICTABLE
from modcal_nodes.simulation.world import World


def seen_by_both(
    seed: int, scale: float = 1.0, target: float = 0.0, kind: str = "point", unrelated: bool = False
) -> Samples:
    """Two of five stations by a second instrument. scale: of its readings; target: how far off its own target is [m]."""
    rng = np.random.default_rng(seed)
    world = World(ur10(), rng, 5e-4, 1e-3, se3.exp(rng.normal(size=6)), se3.exp([0.05, 0.03, 0.12, 0.3, 0.1, 0.2]))
    q = rng.uniform(-2.5, 2.5, (100, 6))
    T = world.tool_in_tracker(q)
    second = np.arange(100) % 5 < 2
    elsewhere = se3.exp([2.0, 1.0, 0.4, 0.3, -0.8, 1.1])
    T[second] = elsewhere @ T[second] @ se3.exp([target, 0.0, 0.0, 0.0, 0.0, 0.0])
    T[second, :3, 3] *= scale
    T[:, :3, 3] += 3e-5 * rng.standard_normal((100, 3))
    if unrelated:
        T[second] = se3.exp(rng.normal(size=(int(second.sum()), 6)))
    samples = samples_of(ur10(), q, T, kind)
    return replace(samples, frames=("tracker", "camera"), frame=second.astype(int))


@pytest.mark.parametrize("fault", [{"scale": 1.001}, {"target": 4e-4}])
def test_instruments_that_do_not_agree_are_named(fault: dict[str, float]) -> None:
    report = calibrate(seen_by_both(1, **fault), ur10(), np.random.default_rng(0), look_for_effects=False).report
    assert report.status == "open"
    said = " ".join(report.open_because)
    assert "which instrument reads it: those in frames 'tracker' and 'camera' do not agree" in said


@pytest.mark.parametrize("seed", [2])
def test_instruments_that_agree_are_not(seed: int) -> None:
    report = calibrate(seen_by_both(seed), ur10(), np.random.default_rng(0), look_for_effects=False).report
    assert report.judged is not None
    assert report.judged.predictable is not None
    assert report.judged.predictable.lower99 < MAX_PREDICTABLE
    assert "instrument reads" not in " ".join(report.open_because)


def test_an_instrument_of_few_readings_is_not_asked() -> None:
    samples = seen_by_both(2)
    keep = (samples.frame == 0) | (np.cumsum(samples.frame) <= 8)
    report = calibrate(
        samples.select(np.flatnonzero(keep)), ur10(), np.random.default_rng(0), look_for_effects=False
    ).report
    assert report.judged is not None
    asked = [n for n in report.judged.not_asked if "camera" in n.what]
    assert [n.needs for n in asked] == ["12 readings of each"]


def test_an_instrument_whose_readings_fit_nowhere_is_refused_by_name() -> None:
    samples = seen_by_both(1, kind="pose", unrelated=True)
    with pytest.raises(BadRecording, match=r"frame 'camera': .*of its 40 readings agree with no place.*left-handed"):
        calibrate(samples, ur10(), np.random.default_rng(0), look_for_effects=False)

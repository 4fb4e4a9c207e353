"""A wrong column that a fit comes to terms with, no station being rejected, is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from cells import record, ur10

from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples


def in_a_small_part(seed: int) -> Samples:
    """Points at postures whose last joints hardly turn, so that other links make up for much of what is wrong."""
    recorded = record(seed, 90, "point")
    rng = np.random.default_rng(seed)
    middle, half = np.array([0.2, -1.0, 1.2, -0.4, 0.6, 0.3]), np.array([0.7, 0.5, 0.5, 0.5, 0.12, 0.12])
    q = middle + half * rng.uniform(-1.0, 1.0, recorded.samples.q.shape)
    seen = recorded.world.tool_in_tracker(q)[:, :3, 3] + rng.normal(0.0, 5e-5, (len(q), 3))
    return replace(recorded.samples, q=q, reading=seen)


def said_of(samples: Samples) -> str:
    report = calibrate(samples, ur10(), np.random.default_rng(0), look_for_effects=False).report
    assert report.rejected == 0
    return " ".join(report.judged.open_because)


def test_joints_that_are_swapped_are_named_though_nothing_is_rejected() -> None:
    samples = in_a_small_part(0)
    said = said_of(replace(samples, q=samples.q[:, [0, 1, 2, 3, 5, 4]]))
    assert "wrist_2_joint and wrist_3_joint look swapped" in said


def test_nothing_is_said_of_the_joints_as_they_are() -> None:
    assert "look swapped" not in said_of(in_a_small_part(0))

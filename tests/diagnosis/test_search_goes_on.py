"""What does not predict is refused, and the search goes on to what does: in many samples as in few."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, samples_of, ur10

from modcal_core.calibration.data_split import split
from modcal_core.geometry import so3
from modcal_core.loop import calibrate
from modcal_core.measurements.recording import SignalTrack
from modcal_core.measurements.samples import Samples

PAN, WRIST_2, WRIST_3 = 0, 4, 5


def misleading(count: int) -> Samples:
    """A wrist that turns a little too far; and signals that other joints follow where they are fitted, and nowhere else.

    They explain most of what is left, and predict nothing.
    """
    made = record(21, count)
    q, rng = made.samples.q, np.random.default_rng(3)
    sets = split(made.samples, np.random.default_rng(0), None, [])
    actual = q.copy()
    actual[:, WRIST_2] += 3e-4 * q[:, WRIST_2]
    signals = {f"/noise_{j}": rng.standard_normal(count) for j in (PAN, WRIST_3)}
    for j, signal in zip((PAN, WRIST_3), signals.values(), strict=True):
        actual[sets.train, j] += 8e-4 * signal[sets.train]
        actual[sets.explain, j] -= 4e-4 * signal[sets.explain]
    T = made.world.tool_in_tracker(actual)
    T[:, :3, 3] += 3e-5 * rng.standard_normal((count, 3))
    samples = samples_of(ur10(), q, T)
    t = samples.stamps
    return replace(samples, signals=tuple(SignalTrack(f"signal:{n}", t, x[:, None], n) for n, x in signals.items()))


@pytest.mark.slow
@pytest.mark.parametrize("count", [200, 620])
def test_a_choice_that_does_not_predict_does_not_end_the_search(count: int) -> None:
    report = calibrate(misleading(count), ur10(), np.random.default_rng(0)).report
    found = [(e.family, e.place) for e in report.effects if e.family != "outliers"]
    assert found == [("gear_ratio", "wrist_2_joint")]
    # what was refused is said where the rest is surely predictable
    assert (report.left is not None) == report.judged.predicted


def swaying(seed: int, count: int = 900) -> Samples:
    """An arm that never stops, on a stand that tilts with its acceleration."""
    rng = np.random.default_rng(seed)
    rate, phase = rng.uniform(0.6, 1.2, (2, 6)), rng.uniform(0.0, 2.0 * np.pi, (2, 6))
    t = 0.05 * np.arange(count)
    angle = t[:, None, None] * rate + phase
    q, acceleration = 0.5 * np.sin(angle).sum(axis=1), -0.5 * (rate**2 * np.sin(angle)).sum(axis=1)
    forward = acceleration[:, 1:2] * np.stack([np.cos(q[:, 0]), np.sin(q[:, 0]), np.zeros(count)], axis=1)
    aside = np.stack([acceleration[:, 0] * np.sin(q[:, 1]), acceleration[:, 2], acceleration[:, 0]], axis=1)
    tilt = so3.exp(2e-4 * forward + 1e-4 * aside)
    T = record(seed, 1).world.tool_in_tracker(q)
    T[:, :3] = tilt @ T[:, :3]
    T[:, :3, 3] += 2e-5 * rng.standard_normal((count, 3))
    return replace(samples_of(ur10(), q, T), stamps=t, moving=np.ones(count, bool))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 6])
def test_of_what_remains_in_motion_nothing_is_named_that_does_not_stand_out(seed: int) -> None:
    """Curves of joints predict neighbours in time, whose errors they share."""
    found = calibrate(swaying(seed), ur10(), np.random.default_rng(0)).report.effects
    assert {effect.place for effect in found} <= {"base", "tracker"}

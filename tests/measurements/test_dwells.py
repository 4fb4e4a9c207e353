"""What a dwell leaves out, and how well its mean is known; a clock that is too far off is refused."""

from __future__ import annotations

import numpy as np
import pytest
from cells import ur10
from cli.recordings import streams

from modcal_core.errors import BadRecording
from modcal_core.measurements.alignment import LIMIT, align
from modcal_core.measurements.dwells import StationRules, deviation_of_mean, find_dwells
from modcal_core.robots.kinematics import forward


@pytest.mark.slow
@pytest.mark.parametrize("settle", [0.1, 0.4, 0.8])
def test_a_dwell_begins_when_the_arm_has_settled(settle: float) -> None:
    rules = StationRules(settle=settle)
    t = np.arange(0.0, 6.0, 0.004)
    stopped, left = 2.0, 5.0
    q = np.where(t < stopped, t - stopped, np.where(t > left, t - left, 0.0))[:, None]
    ((start, end),) = find_dwells(t, q, rules)
    assert start == pytest.approx(stopped + settle, abs=0.01)
    assert end <= left


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.0, 0.6, 0.9])
def test_a_mean_of_readings_that_share_noise_is_known_less_well(rho: float, rng: np.random.Generator) -> None:
    noise = rng.normal(size=(400, 300, 3))  # readings of so many dwells
    for k in range(1, 400):
        noise[k] = rho * noise[k - 1] + np.sqrt(1.0 - rho * rho) * noise[k]
    mean = noise.mean(axis=0)
    said = [deviation_of_mean(noise[:, i] - mean[i]) ** 2 for i in range(300)]
    # at 0.9 a correlation found in 400 readings is a little short, and the mean that was taken off took some of it
    assert 0.7 < np.mean(said) / np.mean(mean**2) < 1.2


@pytest.mark.slow
@pytest.mark.parametrize("late", [LIMIT + 0.2, -LIMIT - 0.2])
def test_a_clock_that_is_too_far_off_is_refused(late: float) -> None:
    def tip(q: np.ndarray) -> np.ndarray:
        return forward(ur10(), q)

    recording, names = streams(20, late=late), ur10().names
    with pytest.raises(BadRecording, match="off the joint states' clock, 0.5 s is the limit"):
        align(recording, names, tip)
    aligned, _ = align(recording, names, tip, limit=2.0)
    assert np.abs(aligned.readings[0].stamps - recording.readings[0].received).max() < 4e-3

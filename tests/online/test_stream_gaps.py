"""An arm in motion, heard at any rate and with gaps: a reading costs at most itself, and what is kept is right."""

from __future__ import annotations

import numpy as np
import pytest

from modcal_core.measurements.kinds.registry import kinds
from modcal_core.measurements.recording import POINT
from modcal_core.measurements.samples import Samples
from modcal_core.online.stream import SampleStream

START = 1.7e9
RATES = (20.0, 125.0)  # Hz


def truth(t: np.ndarray | float) -> np.ndarray:
    """Where two joints are that never stop, in closed form [rad]."""
    t = np.asarray(t)[..., None]
    return np.concatenate([0.8 * np.sin(1.1 * t), 0.5 * np.cos(0.7 * t + 0.3)], axis=-1)


def heard(joints: np.ndarray, readings: np.ndarray) -> tuple[list[Samples], SampleStream]:
    """What becomes of readings at these times, among joint states at those, played in the order of their stamps."""
    stream, out = SampleStream(("a", "b")), []
    position = np.zeros(kinds()[POINT].width)
    for t, is_joint in sorted([(t, True) for t in joints] + [(t, False) for t in readings]):
        if is_joint:
            stream.joint_state(START + t, truth(t))
        else:
            stream.reading(POINT, "tracker", START + t, position)
        out += stream.take()
    return out, stream


def off(samples: list[Samples]) -> float:
    """How far the postures of samples are from the truth at their stamps [rad]."""
    return max(float(np.abs(s.q[0] - truth(s.stamps[0] - START)).max()) for s in samples)


@pytest.mark.slow
@pytest.mark.parametrize("rate", RATES)
def test_readings_in_motion_are_paired_at_every_rate(rate: float) -> None:
    joints = np.arange(0.0, 34.0, 1.0 / rate)
    readings = np.arange(31.0, 33.0, 0.021)
    samples, stream = heard(joints, readings)
    assert stream.counts.unpaired == 0
    assert len(samples) == len(readings)
    assert off(samples) < (3e-5 if rate < 40.0 else 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "gap"), [(125.0, 0.06), (125.0, 0.2)])
def test_a_gap_in_the_joint_states_costs_at_most_the_readings_in_it(rate: float, gap: float) -> None:
    joints = np.arange(0.0, 34.0, 1.0 / rate)
    at = np.arange(31.0, 33.0, 0.4)  # several gaps, at several moments between two readings
    joints = joints[~((joints[:, None] > at) & (joints[:, None] < at + gap)).any(axis=1)]
    readings = np.arange(31.0, 33.3, 0.0037)
    samples, stream = heard(joints, readings)
    inside = ((readings[:, None] > at - 0.02) & (readings[:, None] < at + gap + 0.02)).any(axis=1)
    assert len(samples) + stream.counts.unpaired == len(readings)
    too_wide = np.diff(joints).max() > 0.1  # StationRules.gap
    assert stream.counts.unpaired <= (inside.sum() if too_wide else 0)
    assert off(samples) < 3e-5


def test_readings_without_joint_states_are_counted_and_not_kept_for_ever() -> None:
    stream = SampleStream(("a", "b"))
    position = np.zeros(kinds()[POINT].width)
    for k in range(9000):
        stream.reading(POINT, "tracker", START + 0.005 * k, position)
    assert stream.counts.unpaired == 9000 - 8192

"""What does not predict is refused, and the search goes on to what does: in many samples as in few."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, samples_of, ur10

from modcal_core.calibration.split import split
from modcal_core.loop import calibrate
from modcal_core.measurements.recording import SignalTrack
from modcal_core.measurements.samples import Samples

WRIST_2, WRIST_3 = 4, 5


def misleading(count: int) -> Samples:
    """A wrist that turns a little too far; and a signal that the last joint follows where it is fitted, and nowhere else.

    It explains most of what is left, as a cause of the joint and as one of the tool, and predicts nothing.
    """
    made = record(21, count)
    q, rng = made.samples.q, np.random.default_rng(3)
    sets = split(made.samples, np.random.default_rng(0), None, [])
    signal = rng.standard_normal(count)
    actual = q.copy()
    actual[:, WRIST_2] += 3e-4 * q[:, WRIST_2]
    actual[sets.train, WRIST_3] += 8e-4 * signal[sets.train]
    actual[sets.explain, WRIST_3] -= 4e-4 * signal[sets.explain]
    T = made.world.tool_in_tracker(actual)
    T[:, :3, 3] += 3e-5 * rng.standard_normal((count, 3))
    samples = samples_of(ur10(), q, T)
    return replace(samples, signals=(SignalTrack("signal:/noise", samples.stamps, signal[:, None], "/noise"),))


@pytest.mark.parametrize("count", [200, 620])
def test_a_choice_that_does_not_predict_does_not_end_the_search(count: int) -> None:
    report = calibrate(misleading(count), ur10(), np.random.default_rng(0)).report
    found = [(e.family, e.place) for e in report.effects if e.family != "outliers"]
    assert found == [("gear_ratio", "wrist_2_joint")]
    assert report.left is not None  # what was refused is said

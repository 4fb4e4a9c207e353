"""Half of a recording at another time is no half that may be missing; a tracker that ran longer is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import ur10
from cli.recordings import streams, with_reading

from modcal_core.measurements.inspection import inspect
from modcal_core.measurements.recording import Recording
from modcal_core.preprocess import prepare

HOUR, DAY = 3600.0, 86_400.0


def set_on_the_way(recording: Recording, seconds: float, share: float = 0.5) -> Recording:
    """The recording of a tracker whose clock is set by so much after a share of it."""
    stamps = recording.readings[0].stamps
    begin, end = stamps.min(), stamps.max()
    return with_reading(recording, stamps=np.where(stamps > begin + share * (end - begin), stamps + seconds, stamps))


@pytest.mark.parametrize("seconds", [HOUR, -HOUR, -DAY])
@pytest.mark.parametrize("share", [0.3, 0.7])
def test_a_clock_that_was_set_is_doubted(seconds: float, share: float) -> None:
    spoilt = set_on_the_way(streams(8), seconds, share)
    (said,) = prepare(spoilt, ur10()).doubts
    assert "are stamped before or after all joint states and were left out" in said
    assert "see whether a clock was set while recording" in said
    assert said in inspect(spoilt, ur10()).findings


def test_a_tracker_that_ran_longer_or_paused_is_not() -> None:
    whole = streams(8)
    track = whole.joints[0]
    some = track.stamps < np.quantile(track.stamps, 0.6)
    longer = whole.readings[0].stamps.max()
    fewer = with_joint_rows(whole, some)
    assert longer > fewer.joints[0].stamps.max() + 5.0
    assert prepare(fewer, ur10()).doubts == ()
    stamps = whole.readings[0].stamps
    low, high = np.quantile(stamps, [0.3, 0.6])
    assert prepare(with_readings_of(whole, (stamps < low) | (stamps > high)), ur10()).doubts == ()


def with_joint_rows(recording: Recording, keep: np.ndarray) -> Recording:
    track = recording.joints[0]
    columns = {name: getattr(track, name)[keep] for name in ("stamps", "position", "velocity", "effort", "received")}
    return replace(recording, joints=(replace(track, **columns), *recording.joints[1:]))


def with_readings_of(recording: Recording, keep: np.ndarray) -> Recording:
    return replace(recording, readings=(recording.readings[0].rows(keep), *recording.readings[1:]))

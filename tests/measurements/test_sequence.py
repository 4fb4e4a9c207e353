"""Recordings joined to one: of one clock as they are, of none one after the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from modcal_core.errors import BadRecording
from modcal_core.measurements.recording import SignalTrack
from modcal_core.measurements.samples import after, between, require_new
from tests.cells import record


def test_recordings_of_one_clock_are_left_as_they_are() -> None:
    samples = record(0, 12, "point").samples
    first, second = samples.select(slice(None, 5)), samples.select(slice(5, None))
    same, late = after(second, first)
    assert late == 0.0
    assert same is second
    assert between(first, second) == pytest.approx(0.5 * (samples.stamps[4] + samples.stamps[5]))
    # one from before comes before, whichever is named first
    assert after(first, second) == (first, 0.0)
    assert between(second, first) == between(first, second)


def test_rows_that_are_counted_from_zero_twice_follow_each_other() -> None:
    samples = record(0, 12, "point").samples
    count = np.arange(12.0)
    track = SignalTrack("signal:/heat", count, count[:, None])
    first = replace(samples, stamps=count)
    second = replace(samples, stamps=count, signals=(track,))
    moved, late = after(second, first)
    assert late == 12.0
    np.testing.assert_array_equal(moved.stamps, count + 12.0)
    np.testing.assert_array_equal(moved.signals[0].stamps, count + 12.0)
    assert not moved.clock
    assert between(first, moved) == 11.5
    joined = first.followed_by(moved)
    np.testing.assert_array_equal(joined.station, np.arange(24))


def test_a_recording_that_is_given_twice_is_refused() -> None:
    samples = record(0, 40).samples
    first, rest = samples.select(slice(None, 20)), samples.select(slice(20, None))
    require_new(rest, first, "rest")
    require_new(replace(samples.select(slice(17, None))), first, "three rows in common")
    with pytest.raises(BadRecording, match="--also copy: is a copy: 20 of its 20 readings .* give each recording once"):
        require_new(replace(first, stamps=first.stamps + 1e5), first, "copy")
    # the same postures, measured once more, are another recording
    again = replace(first, reading=first.reading + 1e-6)
    require_new(again, first, "again")

"""Readings that a driver hands over in bursts and stamps when they arrive get the times at which they were taken."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cli.recordings import streams

from modcal_core.geometry.so3 import Array
from modcal_core.measurements.dropouts import Cleaned, cleaned
from modcal_core.measurements.recording import Recording


def handed_over(taken: Array, period: float, apart: float = 5e-5) -> Array:
    """Stamps of arrival of readings that are handed over at multiples of a period."""
    end = (taken // period + 1.0) * period
    number = np.arange(len(end)) - np.searchsorted(end, end)
    return np.asarray(end + apart * number)


def after(recording: Recording, stamps: Array, rows: np.ndarray) -> Cleaned:
    (track,) = recording.readings
    track = replace(track.rows(rows), stamps=stamps)
    return cleaned(replace(recording, readings=(track,)), recording.joints[0].names)


@pytest.mark.parametrize("period", [0.1, 0.33, 0.5])
def test_bursts_are_spread_at_the_rate_of_the_instrument(period: float) -> None:
    recording = streams()
    taken = recording.readings[0].stamps
    clean = after(recording, handed_over(taken, period), np.arange(len(taken)))
    off = clean.recording.readings[0].stamps - taken
    assert np.ptp(off) < 2e-3
    assert abs(off).max() < 0.03
    (note,) = clean.notes
    assert "came in bursts of" in note
    assert f"every {period:g} s" in note


def test_where_readings_are_missing_those_of_a_burst_share_its_time() -> None:
    recording = streams()
    taken = recording.readings[0].stamps
    kept = np.flatnonzero((np.arange(len(taken)) // 50) % 4 != 1)
    clean = after(recording, handed_over(taken[kept], 0.2), kept)
    off = clean.recording.readings[0].stamps - taken[kept]
    assert np.abs(off - np.median(off)).max() < 0.11


@pytest.mark.parametrize("apart", [2e-3, 0.0])
def test_other_stamps_stay(apart: float) -> None:
    """Quick streams at stations, and rows of one rounded time, are no bursts."""
    recording = streams()
    taken = recording.readings[0].stamps
    clean = after(recording, handed_over(taken, 0.1, apart), np.arange(len(taken)))
    assert clean.notes == ()

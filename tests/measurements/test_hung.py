"""A tracker that hangs repeats a pose while the arm goes on; what only looks like that is kept."""

from __future__ import annotations

import numpy as np
import pytest
from cells import ur10
from cli.recordings import stations, streams, with_reading

from modcal_core.measurements.dropouts import HUNG, hung
from modcal_core.measurements.recording import Recording
from modcal_core.preprocess import prepare

NAMES = ur10().names


def held(recording: Recording, *runs: tuple[int, int]) -> Recording:
    """The same recording, each run of readings [start, end) holding its first."""
    values = recording.readings[0].values.copy()
    for start, end in runs:
        values[start:end] = values[start]
    return with_reading(recording, values=values)


def test_runs_over_several_stations_are_left_out_and_make_the_verdict_open() -> None:
    recording = streams(20)
    count = len(recording.readings[0].stamps)
    spoiled = held(recording, (300, 500), (700, 900))
    found = hung(spoiled, NAMES)
    assert found.dropped == ((HUNG, 398),)  # of each run the first is a reading like any other
    assert ["the tracker hung" in said for said in found.doubts] == [True]
    assert len(found.left_out(spoiled).readings[0].stamps) == count - 398

    prepared, whole = prepare(spoiled, ur10()), prepare(recording, ur10())
    assert dict(prepared.dropped)[HUNG] == 398
    assert prepared.doubts == found.doubts
    # what is left stands where it stood before: no mean holds a repeated reading
    near = np.abs(prepared.samples.stamps[:, None] - whole.samples.stamps).argmin(axis=1)
    apart = np.linalg.norm(prepared.samples.reading - whole.samples.reading[near], axis=1)
    assert 10 < len(prepared.samples) < 20
    assert apart.max() < 5e-5  # 20 µm of noise


def test_a_short_hang_is_left_out_and_noted_only() -> None:
    recording = streams(30)
    count = len(recording.readings[0].stamps)
    spoiled = held(recording, (700, 700 + count // 25))  # 4 % of them
    found = hung(spoiled, NAMES)
    assert [reason for reason, _ in found.dropped] == [HUNG]
    assert (len(found.notes), len(found.doubts)) == (1, 0)


def test_stations_in_a_row_that_hold_one_pose_are_left_out() -> None:
    found = hung(held(stations(80), (20, 40)), NAMES)
    assert found.dropped == ((HUNG, 19),)


@pytest.mark.parametrize("what", ["at rest", "held by a bridge", "all alike", "twice"])
def test_what_repeats_for_another_reason_is_kept(what: str) -> None:
    recording = streams(20)
    track = recording.readings[0]
    values = track.values.copy()
    if what == "at rest":  # a coarse instrument at one station
        q, t = recording.joints[0].position, recording.joints[0].stamps
        still = np.flatnonzero(np.abs(q - q[0]).max(axis=1) < 1e-6)
        values[track.stamps <= t[still[-1]]] = values[0]
    elif what == "held by a bridge":  # which publishes ten times as fast as its tracker measures
        values = values[10 * (np.arange(len(values)) // 10)]
    elif what == "all alike":  # the topic of another target is refused as such
        values[:] = values[0]
    else:
        values = np.repeat(values[::2], 2, axis=0)[: len(values)]
    assert hung(with_reading(recording, values=values), NAMES).dropped == ()

"""A tracker that hangs, hands readings over in bursts or drops them: counted by reason, and none is counted twice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import ur10
from cli.recordings import stations, streams, with_reading

from modcal_core.geometry.so3 import Array
from modcal_core.measurements.dropouts import (
    ALONE,
    BETWEEN,
    GLITCHES,
    HUNG,
    OUTSIDE,
    Cleaned,
    cleaned,
    dropped,
    hung,
    together,
    unexpected,
)
from modcal_core.measurements.dwells import StationRules, find_dwells
from modcal_core.measurements.recording import Recording
from modcal_core.measurements.samples import cut_stations
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


def counts(recording: Recording) -> dict[str, int]:
    return dict(dropped(recording, cut_stations(recording, ur10().names)))


def test_readings_without_a_joint_state_are_counted() -> None:
    whole = stations(30)
    t = whole.readings[0].stamps.copy()
    t[[4, 11]] += 0.5  # between two joint states, two seconds apart
    t[-1] += 100.0
    assert counts(with_reading(whole, stamps=t, received=t)) == {ALONE: 2, OUTSIDE: 1}


def test_of_a_stream_all_readings_are_in_a_dwell_between_them_or_wrong() -> None:
    whole = streams(12)
    track, joints = whole.readings[0], whole.joints[0]
    dwells = find_dwells(joints.stamps, joints.position, StationRules())
    inside = np.array([((track.stamps >= a) & (track.stamps < b)).any() for a, b in dwells])
    assert inside.all()
    in_dwell = np.zeros(len(track.stamps), bool)
    for a, b in dwells:
        in_dwell |= (track.stamps >= a) & (track.stamps < b)
    between = int((~in_dwell & (track.stamps >= joints.stamps[0]) & (track.stamps <= joints.stamps[-1])).sum())
    plain = counts(whole)
    outside = int(((track.stamps < joints.stamps[0]) | (track.stamps > joints.stamps[-1])).sum())
    assert plain.get(GLITCHES, 0) == 0
    assert plain[BETWEEN] == between
    assert plain.get(OUTSIDE, 0) == outside
    spoiled = track.values.copy()
    rows = np.flatnonzero(in_dwell)[[5, 40, 41]]
    spoiled[rows, 0] += 0.2  # a glitch of the tracker
    assert counts(with_reading(whole, values=spoiled))[GLITCHES] == 3
    assert unexpected(dropped(whole, cut_stations(whole, ur10().names))) == outside


def test_pieces_add_up() -> None:
    whole = streams(12)
    samples = cut_stations(whole, ur10().names)
    middle = float(np.median(whole.joints[0].stamps))
    parts = [dropped(whole, samples, since=-np.inf, until=middle), dropped(whole, samples, since=middle)]
    assert dict(together(parts))[BETWEEN] == pytest.approx(counts(whole)[BETWEEN], abs=2)

"""Stations: dwells, their uncertainty, clocks; and a tracker that hangs or hands over in bursts, counted by reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import ur10
from cli.recordings import START, recorded, stations, streams, with_reading

from modcal_core.errors import BadRecording
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.alignment import align, clock_offset
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
from modcal_core.measurements.inspection import inspect
from modcal_core.measurements.recording import Recording
from modcal_core.measurements.samples import cut_stations
from modcal_core.preprocess import prepare
from modcal_core.robots.kinematics import chain_forward

NAMES = ur10().names


def tip(q: np.ndarray) -> np.ndarray:
    return chain_forward(ur10(), q)


def test_every_dwell_becomes_one_station() -> None:
    samples = cut_stations(streams(25), NAMES)
    assert samples.stations == 25
    assert not samples.moving.any()
    # 20 µm noise, about 37 readings in 0.75 s
    assert np.median(samples.sigma_position) == pytest.approx(2e-5 / np.sqrt(37), rel=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("count", [36, 37])
def test_a_tool_that_is_knocked_during_a_stand_is_where_it_was_for_most_of_it(count: int) -> None:
    """Half of the readings before and half after have a mean, and a median, where the tool never was."""
    recording = streams(6)
    stamps = recording.readings[0].stamps
    still = cut_stations(recording, NAMES)
    stand = np.flatnonzero(np.abs(stamps - still.stamps[3]) < 0.37)[:count]
    others = np.abs(stamps - still.stamps[3]) < 0.7
    others[stand] = False
    knock = np.array([5e-4, -3e-4, 4e-4])
    for first in stand[1:]:
        values = recording.readings[0].values.copy()
        values[first:, :3] += knock
        whole = with_reading(recording, stamps=stamps[~others], values=values[~others], received=stamps[~others])
        seen = cut_stations(whole, NAMES)
        assert seen.stations == 6
        before = np.linalg.norm(seen.reading[3] - still.reading[3])
        after = np.linalg.norm(seen.reading[3] - still.reading[3] - knock)
        assert min(before, after) < 2e-5  # 20 µm each, eighteen of them at least
        # at an end, one reading or two are a glitch like any other
        assert seen.sigma_position[3] < 1.5e-5


def test_paired_readings_are_stations_as_they_are() -> None:
    recording = stations(30)
    samples = cut_stations(recording, NAMES)
    assert np.array_equal(samples.q, recording.joints[0].position)
    assert np.array_equal(samples.reading, recording.readings[0].values[:, :3])
    assert np.isnan(samples.sigma_position).all()


@pytest.mark.parametrize(("joints", "readings"), [(10, 60), (60, 10)])
def test_pairs_are_recognised_where_one_topic_was_heard_for_longer(joints: int, readings: int) -> None:
    """A recording may be looked at while it comes in, a topic in one go; what both cover are pairs all the same."""
    whole = stations(80)
    track, reading = whole.joints[0], whole.readings[0]
    heard = replace(whole, joints=(track.rows(slice(joints)),), readings=(reading.rows(slice(readings)),))
    samples = cut_stations(heard, ur10().names)
    assert len(samples) == min(joints, readings)
    assert not samples.moving.any()


def test_pairs_of_an_arm_that_never_stands_have_its_velocity_and_acceleration() -> None:
    """A controller that writes both topics with one stamp, during a motion of which the derivatives are known."""
    t = np.arange(0.0, 8.0, 0.008)
    amplitude, pace = np.array([0.8, 0.3, -0.4, 0.5, 0.6, -0.7]), np.array([0.5, 0.7, 0.6, 0.9, 0.8, 1.1])
    phase = pace * t[:, None] + 0.1
    q, v, a = amplitude * np.sin(phase), amplitude * pace * np.cos(phase), -amplitude * pace**2 * np.sin(phase)
    samples = cut_stations(recorded(START + t, q, START + t, se3.to_pose(tip(q))), NAMES)
    assert len(samples) == len(t)
    assert samples.moving.all()
    inner = slice(100, -100)
    assert np.abs(samples.velocity - v)[inner].max() < 0.01
    assert np.abs(samples.acceleration - a)[inner].max() < 0.05


@pytest.mark.slow
def test_a_motion_calibrates_to_the_noise() -> None:
    """At half a metre a second, a millisecond too much would cost half a millimetre; the noise is 0.035 mm."""
    prepared = prepare(streams(60, dwell=0.0, late=0.02), ur10())
    assert prepared.samples.moving.all()
    assert "almost always moving" in " ".join(prepared.notes)
    report = calibrate(prepared.samples, ur10(), np.random.default_rng(0)).report
    assert report.sets.unit == "block"
    before, after = report.size_mm("nominal"), report.size_mm("final")
    assert before.rms > 1.0
    assert after.rms < 1.1 * 2e-2 * np.sqrt(3)


def test_joints_come_by_name() -> None:
    recording = stations(10)
    shuffled = [3, 1, 0, 5, 4, 2]
    track = recording.joints[0]
    other = replace(
        track,
        names=(*[NAMES[j] for j in shuffled], "gripper"),
        position=np.c_[track.position[:, shuffled], np.zeros(10)],
        velocity=np.full((10, 7), np.nan),
        effort=np.full((10, 7), np.nan),
    )
    assert np.array_equal(cut_stations(replace(recording, joints=(other,)), NAMES).q, track.position)


@pytest.mark.slow
@pytest.mark.parametrize("late", [-0.31, 0.0, 0.045])
def test_clock_offset_is_found_on_motion(late: float) -> None:
    recording = streams(20, late=late)
    clock = clock_offset(recording.readings[0], recording.joints[0].stamps, recording.joints[0].position, tip)
    assert clock.offset == pytest.approx(late, abs=4e-3)
    aligned, notes = align(recording, NAMES, tip)
    assert np.abs(aligned.readings[0].stamps - recording.readings[0].received).max() < 4e-3
    assert bool(notes) == (late != 0.0)


@pytest.mark.slow
def test_drift_is_found() -> None:
    recording = streams(120, drift=5e-4)
    aligned, notes = align(recording, NAMES, tip)
    assert np.abs(aligned.readings[0].stamps - recording.readings[0].received).max() < 6e-3
    assert "drifted" in notes[0]


def test_silence_in_motion_tells_no_offset() -> None:
    """A tracker that only speaks while the arm stands still shows no speed to compare."""
    recording = streams(20)
    t, q = recording.joints[0].stamps, recording.joints[0].position
    s = recording.readings[0].stamps
    speed = np.interp(s, t[1:], np.abs(np.diff(q, axis=0)).max(axis=1))
    still = speed == 0.0
    assert clock_offset(recording.readings[0].rows(still), t, q, tip) is None


def findings(recording: Recording) -> str:
    return " ".join(inspect(recording, ur10()).findings)


def test_each_fault_is_found() -> None:
    clean = streams(12)
    reading = clean.readings[0]
    jump = reading.stamps.copy()
    jump[300:] -= 5.0
    assert "jumps back 1 times, by up to" in findings(with_reading(clean, stamps=jump))
    gap = np.r_[0:300, 400 : len(jump)]
    assert "silent 1 times for up to 2.0" in findings(replace(clean, readings=(reading.rows(gap),)))
    stuck = reading.values.copy()
    stuck[100:200] = stuck[100]
    assert "the tracker hung, or had lost its target" in findings(with_reading(clean, values=stuck))
    assert "its clock is +0.200 s off" in findings(with_reading(clean, stamps=reading.stamps + 0.2))
    far = reading.values.copy()
    far[:, :3] *= 1000.0
    assert "looks like millimetres" in findings(with_reading(clean, values=far))


def test_readings_and_joints_of_different_days() -> None:
    with pytest.raises(BadRecording, match="do not overlap"):
        cut_stations(streams(5, late=START), NAMES)


@pytest.mark.slow
def test_a_drift_beyond_the_limit_says_how_far_it_goes() -> None:
    """What it is in the middle is below the limit of 0.5 s that the sentence states; what exceeds it are the ends."""
    recording = streams(120, late=0.42, drift=5e-4)
    with pytest.raises(BadRecording, match=r"drifting by \+\d+ µs/s to 0\.5\d s, 0\.5 s is the limit"):
        align(recording, NAMES, tip)


def test_stations_that_were_written_twice_are_stations_and_no_motion() -> None:
    """A millisecond apart, so that half of the steps between stamps are short: their clock was once said to be off."""
    recording = stations(60)
    twice = np.repeat(np.arange(60), 2)
    later = recording.joints[0].stamps[twice] + np.tile([0.0, 1e-3], 60)
    joints, reading = (
        replace(track.rows(twice), stamps=later, received=later)
        for track in (recording.joints[0], recording.readings[0])
    )
    prepared = prepare(replace(recording, joints=(joints,), readings=(reading,)), ur10())
    assert not prepared.notes
    assert len(prepared.samples) == 120
    assert not prepared.samples.moving.any()


def test_a_clean_recording_has_no_findings() -> None:
    seen = inspect(streams(12), ur10())
    assert [f for f in seen.findings if "noise floor" not in f] == []
    assert seen.uses == ("calibration from poses in 12 dwells",)
    assert inspect(stations(12), ur10()).uses == ("calibration from 12 finished stations (poses)",)


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


def test_stamps_of_arrival_in_motion_get_the_rate_of_the_instrument() -> None:
    """Delays of a part of a period, some of more, with readings lost; and a timer that is late and says when it was."""
    recording, rng = streams(30, dwell=0.0), np.random.default_rng(4)
    (track,) = recording.readings
    delay = rng.exponential(0.003, len(track.stamps)) + 0.02 * (rng.random(len(track.stamps)) < 0.02)
    kept = np.flatnonzero(rng.random(len(delay)) > 0.02)
    arrived = np.maximum.accumulate(track.stamps + delay)[kept]
    late = replace(recording, readings=(replace(track.rows(kept), stamps=arrived, received=arrived),))
    assert any("about a steady rate of" in said for said in inspect(late).findings)
    prepared = prepare(late, ur10())
    assert any("these times fit the motion better" in note for note in prepared.notes)
    off = prepared.samples.stamps - track.stamps[kept][: len(prepared.samples)]
    assert np.percentile(np.abs(off - np.median(off)), 99) < 3e-4

    taken = track.stamps + delay
    there = np.stack([np.interp(taken, track.stamps, x) for x in track.values.T], axis=1)
    timer = replace(recording, readings=(replace(track, stamps=taken, received=taken, values=there),))
    assert not any("fit the motion better" in note for note in prepare(timer, ur10()).notes)


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

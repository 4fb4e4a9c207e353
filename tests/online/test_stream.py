"""Samples from messages as they come, at any rate, with gaps and commands, are those that the whole recording gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import ur10
from cli.recordings import START, stations, streams, with_joints, with_reading

from modcal_core.errors import BadRecording
from modcal_core.geometry import se3
from modcal_core.measurements.kinds.registry import kinds
from modcal_core.measurements.recording import POINT, Recording
from modcal_core.measurements.samples import Samples, cut_stations
from modcal_core.online.stream import LatestRows, SampleStream

NAMES = ur10().names


def play(recording: Recording, stream: SampleStream | None = None, flush: bool = True) -> Samples:
    """Feed a recording in the order in which its messages were received."""
    stream = stream or SampleStream(NAMES)
    joints, reading = recording.joints[0], recording.readings[0]
    order = [NAMES.index(n) for n in joints.names]
    back = np.argsort(order)
    events = [(float(r), 0, i) for i, r in enumerate(joints.received)]
    events += [(float(r), 1, i) for i, r in enumerate(reading.received)]
    out: list[Samples] = []
    for _, which, i in sorted(events):
        if which == 0:
            stream.joint_state(float(joints.stamps[i]), joints.position[i][back])
        else:
            stream.reading(reading.kind, reading.frame, float(reading.stamps[i]), reading.values[i])
        out += stream.take()
    if flush:
        stream.flush()
        out += stream.take()
    return out[-1].join(*out[:-1])


@pytest.mark.slow
def test_stands_become_the_stations_of_the_recording() -> None:
    recording = streams(30)
    live, whole = play(recording), cut_stations(recording, NAMES)
    assert len(live) == len(whole) == 30
    # one detector of dwells, so the same to the last digit
    for name in ("q", "reading", "R", "stamps", "sigma_position", "sigma_rotation", "approach"):
        np.testing.assert_array_equal(getattr(live, name), getattr(whole, name), err_msg=name)
    assert not live.moving.any()


def test_finished_stations_are_paired_as_they_are() -> None:
    recording = stations(40)
    live, whole = play(recording), cut_stations(recording, NAMES)
    assert len(live) >= 38  # of the first two it is not known yet how fast messages come
    rows = np.searchsorted(whole.stamps, live.stamps)
    assert (live.q == whole.q[rows]).all()
    assert (live.reading == whole.reading[rows]).all()


def test_joints_that_come_late_or_twice_are_counted() -> None:
    stream = SampleStream(NAMES)
    for stamp in (0.0, 0.01, 0.02, 0.02, 0.015, 0.03):
        stream.joint_state(START + stamp, np.zeros(6))
    assert stream.counts.late == 2
    assert stream.counts.jumps == 0


def test_a_clock_set_back_begins_anew() -> None:
    recording = streams(12)
    stream = SampleStream(NAMES)
    first = play(recording, stream)
    earlier = with_reading(
        with_joints(recording, stamps=recording.joints[0].stamps - 5000.0), stamps=recording.readings[0].stamps - 5000.0
    )
    second = play(earlier, stream)
    assert stream.counts.jumps == 1
    assert len(first) == len(second) == 12
    assert np.abs(first.q - second.q).max() < 1e-9
    assert (second.station > first.station.max()).all()


def test_encoder_noise_is_no_motion(rng: np.random.Generator) -> None:
    recording = streams(10, dwell=2.0)
    q = recording.joints[0].position
    noisy = with_joints(recording, position=q + 2e-4 * rng.standard_normal(q.shape))
    assert len(play(noisy)) >= 9


@pytest.mark.slow
def test_memory_is_bounded() -> None:
    stream = SampleStream(NAMES)
    pose = se3.to_pose(np.eye(4))
    for i in range(40_000):
        stream.joint_state(START + 1e-3 * i, np.full(6, 1e-3 * i))
        if i % 5 == 0:
            stream.reading("pose", "tracker", START + 1e-3 * i + 1e-4, pose)
    assert len(stream._states._t) <= 20_000
    assert all(len(r.waiting) <= 10_000 for r in stream._readings.values())


@pytest.mark.parametrize("kind", ["nan", "quaternion", "joint"])
def test_what_is_no_number_is_refused_and_harms_nothing(kind: str) -> None:
    recording = streams(6)
    stream = SampleStream(NAMES)
    pose = recording.readings[0].values[0].copy()
    stream.joint_state(START - 1.0, np.zeros(6))
    if kind == "joint":
        with pytest.raises(BadRecording, match="elbow_joint"):
            stream.joint_state(START - 0.9, np.array([0, 0, np.nan, 0, 0, 0]))
    else:
        pose[0 if kind == "nan" else 6] = np.nan if kind == "nan" else 3.0
        with pytest.raises(BadRecording, match="pose in tracker"):
            stream.reading("pose", "tracker", START - 0.9, pose)
    assert len(play(recording, stream)) == 6


@pytest.mark.slow
@pytest.mark.parametrize("dwell", [1.0, 0.01])
def test_following_is_that_of_the_recording(dwell: float) -> None:
    recording = streams(12 if dwell == 1.0 else 60, dwell=dwell)
    joints = recording.joints[0]
    told = joints.position + 1e-3 * np.sin(joints.stamps - START)[:, None]
    whole = cut_stations(replace(recording, commands=(replace(joints, position=told),)), NAMES)
    stream = SampleStream(NAMES)
    at = 0

    class Told(SampleStream):
        def joint_state(self, stamp, q, effort=None):  # type: ignore[no-untyped-def]
            nonlocal at
            self.command(joints.stamps[at : at + 1], told[at : at + 1])
            at += 1
            super().joint_state(stamp, q, effort)

    live = play(recording, stream=Told(NAMES))
    rows = np.searchsorted(whole.stamps, live.stamps)
    assert len(live) > 10
    assert stream.counts.late == 0
    assert np.abs(live.following - whole.following[rows]).max() < (1e-12 if dwell == 1.0 else 2e-5)


def test_a_new_trajectory_takes_the_place_of_the_rest_of_the_old() -> None:
    told = LatestRows(2, 4096)
    told.add(np.array([0.0, 1.0, 2.0, 3.0]), np.array([[0.0, 5.0], [0.1, 5.0], [0.2, 5.0], [0.3, 5.0]]))
    told.add(np.array([1.5]), np.array([[0.05, np.nan]]))  # b is not named and stays
    t = np.arange(0.0, 4.0, 0.5)
    q = np.tile([0.0, 4.9], (len(t), 1))
    np.testing.assert_allclose(told.following(t, q, (1.0, 1.0)), [0.1, 0.1])
    np.testing.assert_allclose(told.following(t, q, (1.5, 3.5)), [0.05, 0.1])
    assert np.isnan(told.following(t - 9.0, q, (-9.0, -9.0))).all()


BEGIN = 1.7e9
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
            stream.joint_state(BEGIN + t, truth(t))
        else:
            stream.reading(POINT, "tracker", BEGIN + t, position)
        out += stream.take()
    return out, stream


def off(samples: list[Samples]) -> float:
    """How far the postures of samples are from the truth at their stamps [rad]."""
    return max(float(np.abs(s.q[0] - truth(s.stamps[0] - BEGIN)).max()) for s in samples)


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
        stream.reading(POINT, "tracker", BEGIN + 0.005 * k, position)
    assert stream.counts.unpaired == 9000 - 8192


def test_readings_of_a_burst_share_the_time_since_the_one_before() -> None:
    """A driver hands over 17 readings every third of a second; an instrument of 2 kHz has no bursts."""
    joints, taken = np.arange(0.0, 42.0, 0.01), 31.0 + 0.02 * np.arange(17 * 29)
    arrived = np.ceil((taken - 31.0 + 1e-9) / 0.34) * 0.34 + 31.0
    arrived += 1e-4 * (np.arange(len(taken)) - np.searchsorted(arrived, arrived))
    samples, stream = heard(joints, arrived)
    stamps = np.array([s.stamps[0] - BEGIN for s in samples])
    late = stamps[40:] - taken[40 : len(stamps)]
    assert stream.counts.bursts == pytest.approx(29, abs=1)
    assert float(np.ptp(late)) < 2e-3  # a delay, which is fitted, and no more
    assert off(samples[40:]) < 1e-6
    fast = np.arange(31.0, 31.5, 5e-4)
    samples, stream = heard(joints[:3300], fast)
    assert stream.counts.bursts == 0
    np.testing.assert_allclose([s.stamps[0] - BEGIN for s in samples], fast, atol=1e-6)

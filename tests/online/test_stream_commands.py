"""A stream knows how far joints are from their commands, as the whole recording does; also of short stands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cli.recordings import START, streams
from online.test_stream import NAMES, play

from modcal_core.measurements.recording import JointTrack, ReadingTrack, Recording
from modcal_core.measurements.samples import cut_stations
from modcal_core.online.stream import LatestRows, SampleStream


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


def test_commands_do_not_fill_memory() -> None:
    told = LatestRows(1, 4096)
    for k in range(300):
        told.add(0.1 * (100 * k + np.arange(100)), np.full((100, 1), 1e-3 * k))
    t = np.array([0.1 * (100 * 299 + 50)])
    np.testing.assert_allclose(told.following(t, np.array([[0.25]]), (t[0], t[0])), [0.299 - 0.25])


def test_standstills_with_nothing_between_them_are_stations_live_too() -> None:
    rng = np.random.default_rng(0)
    goals = rng.uniform(-1.0, 1.0, (30, 6))
    within = np.arange(0.0, 0.4, 0.04)
    t = START + (3.0 * np.arange(30)[:, None] + within).ravel()
    q = np.repeat(goals, len(within), axis=0)
    unknown = np.full_like(q, np.nan)
    poses = np.tile([0.5, 0.2, 0.1, 0.0, 0.0, 0.0, 1.0], (len(t), 1))
    recording = Recording(
        (JointTrack(NAMES, t, q, unknown, unknown, t),), (ReadingTrack("pose", "tracker", t + 1e-3, poses, t + 1e-3),)
    )
    live, whole = play(recording), cut_stations(recording, NAMES)
    assert len(whole) == 30
    assert not whole.moving.any()
    assert len(live) >= 29
    rows = np.abs(whole.stamps[:, None] - live.stamps).argmin(axis=0)
    assert np.abs(live.q - whole.q[rows]).max() < 1e-12

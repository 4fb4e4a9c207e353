"""A stream knows how far joints are from their commands, as the whole recording does; also of short stands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cli.recordings import START, streams
from online.test_stream import NAMES, play

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

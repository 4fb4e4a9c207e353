"""A joint that mimics another and was not recorded stands where its leader puts it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modcal_core.measurements import JointTrack, Recording, cleaned
from modcal_core.robots import Chain, Follower

CHAIN = replace(
    Chain.build(["a", "b", "c"], np.tile(np.eye(4), (4, 1, 1))),
    follows=(Follower(1, "a", -2.0, 0.5), Follower(2, "rod", 3.0, 0.0)),
)


def recorded(*names: str) -> Recording:
    q = np.linspace(0.1, 0.4, 4 * len(names)).reshape(4, -1)
    track = JointTrack(names, np.arange(4.0), q, 10.0 * q, np.zeros_like(q), np.arange(4.0))
    return Recording(joints=(track,), readings=(), signals=())


def test_followers_take_position_and_velocity_of_their_leaders() -> None:
    (track,) = cleaned(recorded("a", "rod"), CHAIN.names, CHAIN).recording.joints
    assert track.names == ("a", "rod", "b", "c")
    q = recorded("a", "rod").joints[0].position
    assert np.allclose(track.position[:, 2:], np.c_[0.5 - 2.0 * q[:, 0], 3.0 * q[:, 1]])
    assert np.allclose(track.velocity[:, 2:], 10.0 * np.c_[-2.0 * q[:, 0], 3.0 * q[:, 1]])
    assert np.isnan(track.effort[:, 2:]).all()


def test_what_was_recorded_is_kept() -> None:
    whole = recorded("a", "b", "rod", "c")
    (track,) = cleaned(whole, CHAIN.names, CHAIN).recording.joints
    assert track.names == ("a", "b", "rod", "c")
    assert np.array_equal(track.position, whole.joints[0].position[: len(track.stamps)])

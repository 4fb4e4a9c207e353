"""Commanded − measured: what holds until when, over which joint states it is averaged, and where it is not known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import ur10
from cli.recordings import START, streams

from modcal_core.errors import BadRecording
from modcal_core.measurements.recording import JointTrack, Recording, commanded_at, following
from modcal_core.measurements.samples import Samples, cut_stations

NAMES = ur10().names


def told(t: list[float], x: list[float], names: tuple[str, ...] = ("a",)) -> JointTrack:
    position = np.tile(np.array(x, dtype=float)[:, None], (1, len(names)))
    unknown = np.full(position.shape, np.nan)
    return JointTrack(names, np.array(t), position, unknown, unknown, np.array(t), "/joint_commands")


def test_a_command_holds_until_the_next_and_a_course_is_interpolated() -> None:
    track = told([1.0, 5.0, 5.05, 5.1], [0.1, 0.5, 0.6, 0.7])
    at = commanded_at((track,), ("a", "b"), np.array([0.9, 1.0, 4.99, 5.025, 9.0]))
    np.testing.assert_allclose(at[:, 0], [np.nan, 0.1, 0.1, 0.55, 0.7])
    assert np.isnan(at[:, 1]).all()
    first = told([0.0], [0.3])
    assert commanded_at((first, track), ("a",), np.array([2.0]))[0, 0] == 0.3  # the preferred topic comes first


def commanded(recording: Recording, apart: float) -> Recording:
    """The recording with a command at each joint state, so far from what is measured."""
    joints = recording.joints[0]
    return replace(recording, commands=(replace(joints, position=joints.position + apart, topic="/joint_commands"),))


@pytest.mark.parametrize("dwell", [1.0, 0.0])
def test_samples_know_how_far_joints_are_from_their_commands(dwell: float) -> None:
    samples = cut_stations(commanded(streams(8, dwell=dwell), 2e-3), NAMES)
    assert samples.moving.all() == (dwell == 0.0)
    known = samples.following[1:-1]
    assert np.abs(known - 2e-3).max() < 1e-12
    assert np.isnan(cut_stations(streams(3), NAMES).following).all()


def test_what_no_joint_follows_is_no_command() -> None:
    """Degrees on the command's topic, or an arm led by hand while an old command stands."""
    assert np.isnan(cut_stations(commanded(streams(5), 0.5), NAMES).following).all()


def test_arrays_may_come_with_commands() -> None:
    rng = np.random.default_rng(0)
    q, p = rng.normal(size=(20, 3)), rng.normal(size=(20, 3))
    samples = Samples.from_arrays(q, points=p, commanded=q + 1e-3)
    np.testing.assert_allclose(samples.following, 1e-3)
    assert np.array_equal(samples.select(np.array([3])).following, samples.following[3:4])
    with pytest.raises(BadRecording, match="commanded: have shape"):
        Samples.from_arrays(q, points=p, commanded=q[:, :2])


def test_commands_without_a_measured_joint_between_them_are_asked_at_the_moment() -> None:
    recording = streams(8)
    track = told([START - 1.0], [0.0], NAMES)
    samples = cut_stations(replace(recording, commands=(track,)), NAMES)
    near = np.abs(samples.q) < 0.2
    assert np.isfinite(samples.following[near]).all()
    assert np.isnan(samples.following[~near]).all()
    np.testing.assert_allclose(samples.following[near], -samples.q[near])


@pytest.mark.parametrize("behind", [0.0, 3e-4, -3e-4, -1.0])
def test_a_command_noted_just_behind_its_station_belongs_to_it(behind: float) -> None:
    """Stations written one by one, a message after the other, in either order; or told a second before."""
    rng = np.random.default_rng(0)
    q, t = rng.uniform(-0.09, 0.09, (20, 6)), 100.0 + 4.0 * np.arange(20)
    unknown = np.full_like(q, np.nan)
    spans = np.stack([t, t], axis=1)
    track = JointTrack(NAMES, t + behind, q + 1e-3, unknown, unknown, t, "/joint_commands")
    np.testing.assert_allclose(following((track,), NAMES, t, q, spans), 1e-3)
    often = 100.0 + 0.1 * np.arange(800)  # of a driver, a joint state just before a command has not heard of it
    held = following((replace(track, position=q),), NAMES, often, np.repeat(q, 40, axis=0), spans[1:])
    np.testing.assert_allclose(held, q[:-1] - q[1:] if behind > 0.0 else 0.0 * q[1:], atol=1e-12)

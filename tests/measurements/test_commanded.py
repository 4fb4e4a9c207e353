"""Commands, followers and joints beside the arm; recordings that are joined, and known again by their readings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, ur10
from cli.recordings import START, stations, streams
from verdict.visits import tour, visited

from modcal_core.calibration.store import from_data, to_data
from modcal_core.errors import BadRecording
from modcal_core.evaluation import evaluate
from modcal_core.loop import calibrate
from modcal_core.measurements import UNREAD, cleaned, require_usable
from modcal_core.measurements.checks import other_joints, others_at, spoken_name
from modcal_core.measurements.recording import JointTrack, Recording, SignalTrack, commanded_at, following
from modcal_core.measurements.samples import (
    Samples,
    after,
    between,
    cut_stations,
    marks_of,
    require_new,
    share_of_known,
)
from modcal_core.outcome.contents import Outcome
from modcal_core.preprocess import prepare
from modcal_core.robots import Chain, Follower
from modcal_core.robots.urdf import read_chain
from modcal_core.verdict.floor import returns_of
from modcal_core.verdict.tolerance import Asked

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
    with pytest.raises(BadRecording, match="commanded: has shape"):
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


def test_a_recording_without_readings_says_what_could_not_be_read() -> None:
    """Joint states of ROS 2 beside a tracker in another encoding: the tracker is not silent."""
    whole = recorded("a", "b", "rod", "c")
    what = "7 messages in the encoding json on /tracker/pose, which is not read: write them as a table"
    with pytest.raises(BadRecording, match=what):
        require_usable(replace(whole, warnings=(f"{UNREAD}{what}.",)), CHAIN)
    with pytest.raises(BadRecording, match="check that the tracker runs"):
        require_usable(whole, CHAIN)


def test_joints_that_move_and_are_not_of_the_arm_are_signals() -> None:
    recording = stations(40)
    arm = recording.joints[0]
    way = np.linspace(0.0, 1.0, 40)
    position = np.stack([way, np.full(40, 0.3), np.full(40, np.nan)], axis=1)
    unknown = np.full_like(position, np.nan)
    beside = JointTrack(("left_1", "left_2", "gripper"), arm.stamps, position, unknown, unknown, arm.stamps, "/left")
    both = replace(recording, joints=(arm, beside))
    samples = prepare(both, read_chain(str(recording.robot_description))).samples
    (signal,) = [track for track in samples.signals if "left" in track.name]
    assert spoken_name(signal.name) == "left_1"
    assert signal.topic == "/left"
    assert np.allclose(others_at(samples)[:, 0], np.interp(samples.stamps, arm.stamps, way))
    assert other_joints(recording, samples) == ()


def test_a_posture_is_come_back_to_only_where_the_other_joints_are_as_before() -> None:
    samples = visited(1, 60, 7)
    _, _, back = tour(1, 60, 7)

    def beside(value: np.ndarray) -> Samples:
        track = SignalTrack("signal:/joint_states#joint left_1", samples.stamps, value[:, None], "/joint_states")
        return replace(samples, signals=(track,))

    assert len(returns_of(samples)) == 7
    assert len(returns_of(beside(np.zeros(len(samples))))) == 7
    elsewhere = np.zeros(len(samples))
    elsewhere[back[:3]] = 0.4
    assert sorted(rows[1] for rows in returns_of(beside(elsewhere))) == back[3:]


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


def read_anew(samples: Samples, rng: np.random.Generator) -> Samples:
    """The same postures, returned to as the arm does, and read once more."""
    q = samples.q + 1e-5 * rng.standard_normal(samples.q.shape)
    return replace(samples, q=q, reading=samples.reading + 2e-5 * rng.standard_normal(samples.reading.shape))


@pytest.mark.parametrize("count", [60, 5000])
@pytest.mark.parametrize("clock", [True, False])
def test_a_recording_and_its_parts_are_known(count: int, clock: bool, rng: np.random.Generator) -> None:
    chain = ur10()
    samples = Samples.from_arrays(rng.uniform(-1.5, 1.5, (count, chain.n)), points=rng.normal(size=(count, 3)))
    samples = replace(samples, clock=clock)
    marks = marks_of(samples)
    assert len(marks) == 2 * min(count, 256)
    assert share_of_known(marks, samples)[0] == 1.0
    assert share_of_known(marks, samples.select(slice(0, count // 2)))[0] == 1.0
    other = read_anew(samples, rng)
    assert share_of_known(marks, other)[0] == 0.0
    some = replace(other, **{
        name: np.concatenate([getattr(samples, name)[: count // 3], getattr(other, name)[count // 3 :]])
        for name in ("q", "reading")
    })  # fmt: skip
    assert share_of_known(marks, some)[0] == pytest.approx(1.0 / 3.0, abs=0.1)
    assert share_of_known((), samples)[0] == 0.0
    rounded = replace(
        samples, q=np.round(samples.q, 5), reading=np.round(samples.reading, 4), stamps=samples.stamps + 9
    )
    assert share_of_known(marks, rounded)[0] == 0.0
    assert share_of_known(marks, rounded, rounded=True)[0] > 0.95
    assert share_of_known(marks, other, rounded=True)[0] < 0.75


def met(report: Outcome) -> str:
    tolerance = report.with_tolerance(Asked(5.0)).tolerance
    return tolerance.result


@pytest.mark.slow
def test_an_error_on_the_own_recording_is_not_held_out(rng: np.random.Generator) -> None:
    made = record(2, 80)
    shipped = from_data(to_data(calibrate(made.samples, ur10(), rng, look_for_effects=False).calibration))
    own = evaluate(shipped, made.samples, rng)
    assert own.status == "open"
    assert any("of the calibration's own recording" in said for said in own.open_because)
    assert met(own) != "PASS"
    other = evaluate(shipped, read_anew(made.exact, rng), rng)
    assert not any("own recording" in said for said in other.open_because)
    assert met(other) == "PASS"

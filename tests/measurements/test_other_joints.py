"""Joints beside the arm's own: what they do may move the tool, and a posture is the same only where they are as well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from cli.recordings import stations
from verdict.visits import tour, visited

from modcal_core.measurements.recording import JointTrack, SignalTrack
from modcal_core.measurements.samples import Samples, other_joints, others_at, spoken_name
from modcal_core.preprocess import prepare
from modcal_core.robots.urdf import read_chain
from modcal_core.verdict.floor import returns_of


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

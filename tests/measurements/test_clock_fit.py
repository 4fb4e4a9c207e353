"""Clocks: agreeing ones are left alone, a delay is told to a fraction of a millisecond, and glitches do not move it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cells import ur10
from cli.recordings import streams, with_joints, with_reading

from modcal_core.errors import BadRecording
from modcal_core.geometry import se3
from modcal_core.measurements.alignment import align, clock_offset
from modcal_core.measurements.recording import JointTrack, ReadingTrack, Recording
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.urdf import read_chain
from modcal_nodes.simulation.program import Program, tour

ROBOTS = Path(__file__).resolve().parents[2] / "examples" / "robots"
TOOL = (0.06, -0.04, 0.15)


def cell(chain: Chain, seed: int, late: float = 0.0, count: int = 20, noise: float = 0.0) -> Recording:
    """Joint states at 50 Hz, and points at 25 Hz whose stamps are late, of an arm that visits postures."""
    rng = np.random.default_rng(seed)
    program = Program(np.clip(np.zeros(chain.n), chain.lower, chain.upper))
    program.reset(0.0, tour(chain, count, 0.8, 0.8, rng))
    t = np.arange(0.0, program.end, 0.02)
    s = np.arange(0.0083, program.end, 0.04)
    T = chain_forward(chain, np.array([program.at(x) for x in s])) @ se3.transform(p=TOOL)
    points = T[:, :3, 3] + noise * rng.standard_normal((len(s), 3))
    q = np.array([program.at(x) for x in t])
    unknown = np.full_like(q, np.nan)
    return Recording(
        (JointTrack(chain.names, t, q, unknown, unknown, t),), (ReadingTrack("point", "tracker", s + late, points, s),)
    )


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["panda", "xarm7"])
def test_clocks_that_agree_are_left_alone(robot: str) -> None:
    chain = read_chain((ROBOTS / f"{robot}.urdf").read_text())
    off, sure = [], []
    for seed in range(8):
        recording = cell(chain, seed)
        assert align(recording, chain.names, lambda q: chain_forward(chain, q))[1] == ()
        found = clock_offset(
            recording.readings[0],
            recording.joints[0].stamps,
            recording.joints[0].position,
            lambda q: chain_forward(chain, q),
        )
        off.append(found.offset)
        sure.append(found.std)
    assert np.abs(off).max() < 1e-3
    # the standard deviation is that of these offsets: chi-square of eight, 0.01 % beyond on either side
    assert 0.7 < np.sum((np.array(off) / sure) ** 2) < 35.0


@pytest.mark.parametrize("late", [-0.1, 0.006])
def test_a_delay_is_found_with_the_point_that_is_seen(late: float) -> None:
    chain = read_chain((ROBOTS / "panda.urdf").read_text())
    recording = cell(chain, 1, late, noise=1e-4)
    aligned, notes = align(recording, chain.names, lambda q: chain_forward(chain, q))
    (note,) = notes
    assert f"was {1e3 * late:+.0f} ms off" in note
    assert np.abs(aligned.readings[0].stamps - recording.readings[0].received).max() < 1e-3


@pytest.mark.parametrize("late", [0.0, 0.12])
def test_glitches_do_not_move_the_clock(late: float, rng: np.random.Generator) -> None:
    """Eight joint states and eight readings are far off, as after a flipped bit; the delay is still found."""
    recording = streams(30, late=late)
    q, values = recording.joints[0].position.copy(), recording.readings[0].values.copy()
    for changed in (q, values):
        rows = rng.choice(len(changed), 8, replace=False)
        changed[rows, 1] += rng.choice([-1.0, 1.0], 8) * 10.0 ** rng.uniform(0.0, 6.0, 8)
    spoiled = with_reading(with_joints(recording, position=q), values=values)
    chain = ur10()
    order = [spoiled.joints[0].names.index(name) for name in chain.names]
    found = clock_offset(spoiled.readings[0], spoiled.joints[0].stamps, q[:, order], lambda p: chain_forward(chain, p))
    assert found.offset == pytest.approx(late, abs=0.004)


@pytest.mark.parametrize("seconds", [1.5, 4.9])
def test_a_recording_shorter_than_the_lags_looked_for(seconds: float) -> None:
    """As a calibrator that was just started holds one; it may know no offset, but it says no wrong one."""
    recording = streams(4)
    track, reading = recording.joints[0], recording.readings[0]
    begin = float(track.stamps[0]) + 0.5
    j = (track.stamps >= begin) & (track.stamps < begin + seconds)
    r = (reading.stamps >= begin) & (reading.stamps < begin + seconds)
    chain = ur10()
    order = [track.names.index(name) for name in chain.names]
    q = track.position[j][:, order]
    found = clock_offset(reading.rows(r), track.stamps[j], q, lambda p: chain_forward(chain, p))
    assert found is None or abs(found.offset) < 0.02


def test_a_clock_that_is_set_while_recording() -> None:
    recording = streams(80)
    track, reading = recording.joints[0], recording.readings[0]
    chain = ur10()
    q = track.position[:, [track.names.index(name) for name in chain.names]]
    middle = float(np.median(reading.stamps))
    jumped = reading.stamps + np.where(reading.stamps < middle, 1.4, 0.0)
    with pytest.raises(BadRecording, match=r"jumps by -1\.(39|40|41) s"):
        clock_offset(replace(reading, stamps=jumped), track.stamps, q, lambda p: chain_forward(chain, p))

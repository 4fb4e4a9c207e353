"""Dwells and rows: what is left out, how well a mean is known, sides of arrival; and clocks that differ."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cells import joint_track, ur10
from cli.recordings import streams, with_joints, with_reading

from modcal_core.errors import BadRecording
from modcal_core.geometry import se3
from modcal_core.measurements.alignment import LIMIT, align, clock_offset
from modcal_core.measurements.dwells import (
    Approach,
    StationRules,
    deviation_of_mean,
    dwells_of,
    find_dwells,
    spread_rows,
)
from modcal_core.measurements.recording import ReadingTrack, Recording
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.urdf import read_chain
from modcal_nodes.simulation.program import Program, tour


@pytest.mark.slow
@pytest.mark.parametrize("settle", [0.1, 0.8])
def test_a_dwell_begins_when_the_arm_has_settled(settle: float) -> None:
    rules = StationRules(settle=settle)
    t = np.arange(0.0, 6.0, 0.004)
    stopped, left = 2.0, 5.0
    q = np.where(t < stopped, t - stopped, np.where(t > left, t - left, 0.0))[:, None]
    ((start, end),) = find_dwells(t, q, rules)
    assert start == pytest.approx(stopped + settle, abs=0.01)
    assert end <= left


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.0, 0.9])
def test_a_mean_of_readings_that_share_noise_is_known_less_well(rho: float, rng: np.random.Generator) -> None:
    noise = rng.normal(size=(400, 300, 3))  # readings of so many dwells
    for k in range(1, 400):
        noise[k] = rho * noise[k - 1] + np.sqrt(1.0 - rho * rho) * noise[k]
    mean = noise.mean(axis=0)
    said = [deviation_of_mean(noise[:, i] - mean[i]) ** 2 for i in range(300)]
    # at 0.9 a correlation found in 400 readings is a little short, and the mean that was taken off took some of it
    assert 0.7 < np.mean(said) / np.mean(mean**2) < 1.2


@pytest.mark.slow
@pytest.mark.parametrize("late", [LIMIT + 0.2, -LIMIT - 0.2])
def test_a_clock_that_is_too_far_off_is_refused(late: float) -> None:
    def tip(q: np.ndarray) -> np.ndarray:
        return chain_forward(ur10(), q)

    recording, names = streams(20, late=late), ur10().names
    with pytest.raises(BadRecording, match="off the joint states' clock, 0.5 s is the limit"):
        align(recording, names, tip)
    aligned, _ = align(recording, names, tip, limit=2.0)
    assert np.abs(aligned.readings[0].stamps - recording.readings[0].received).max() < 4e-3


def bursts(stand: float, count: int, rate: float = 25.0, gap: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and postures of an arm that is recorded only while it stands, at another posture each time."""
    rng = np.random.default_rng(0)
    within = np.arange(0.0, stand, 1.0 / rate)
    t = ((stand + gap) * np.arange(count)[:, None] + within).ravel()
    q = np.repeat(rng.uniform(-1.0, 1.0, (count, 6)), len(within), axis=0)
    return t, q + 1e-6 * rng.standard_normal(q.shape)


@pytest.mark.parametrize(("stand", "rate"), [(0.4, 25.0), (0.3, 50.0), (2.0, 10.0)])
def test_a_standstill_that_is_recorded_by_itself_is_a_dwell(stand: float, rate: float) -> None:
    t, q = bursts(stand, 20, rate)
    dwells = find_dwells(t, q, StationRules())
    assert len(dwells) == 20
    begins = (stand + 3.0) * np.arange(20)
    assert (dwells[:, 0] >= begins).all()
    assert (dwells[:, 1] <= begins + stand).all()
    assert (dwells[:, 1] - dwells[:, 0] >= 0.3 * stand).all()


@pytest.mark.parametrize(
    ("count", "off_mm", "used"),
    [
        (40, [0.0], 10),
        (40, [0.1], 9),
        (40, [0.4, 0.2, 0.1], 7),
        (40, np.linspace(0.5, 0.0, 10).tolist(), 9),  # never at rest
        (6, [0.0], 9),  # a few do not tell
    ],
)
def test_a_standstill_counts_from_where_it_has_settled(count: int, off_mm: list[float], used: int) -> None:
    """Ten readings that scatter by 0.06 mm; the first of them are off by so much, towards either side."""
    rng = np.random.default_rng(3)
    t, q = bursts(0.4, count)
    off = 1e-3 * np.r_[off_mm, np.zeros(10 - len(off_mm))] * rng.choice([-1.0, 1.0], (count, 1))
    values = np.repeat(rng.uniform(-1.0, 1.0, (count, 3)), 10, axis=0) + rng.normal(0.0, 6e-5, (len(t), 3))
    values[:, 0] += off.ravel()
    track = ReadingTrack("point", "tracker", t + 1.7e-3, values, t + 1.7e-3)
    dwells = dwells_of(t, q, [track], StationRules())
    within = np.diff(np.searchsorted(track.stamps, dwells), axis=1)
    assert within.tolist() == [[used]] * count


@pytest.mark.parametrize(("stand", "found"), [(0.4, 30), (0.45, 30), (0.05, 0)])
def test_short_stands_are_dwells_where_most_are_short(stand: float, found: int) -> None:
    """From posture to posture in a second, without ever standing as long as the rules ask for."""
    rng = np.random.default_rng(1)
    goals = rng.uniform(-1.0, 1.0, (31, 6))
    t = np.arange(0.0, 30 * (1.0 + stand), 0.01)
    leg = np.minimum((t / (1.0 + stand)).astype(int), 29)
    u = np.clip(t - leg * (1.0 + stand), 0.0, 1.0)[:, None]
    q = goals[leg] + (10 * u**3 - 15 * u**4 + 6 * u**5) * (goals[leg + 1] - goals[leg])
    dwells = find_dwells(t, q, StationRules())
    assert len(dwells) == found
    for start, end in dwells:
        into = start % (1.0 + stand)
        assert into > 1.0  # the arm has stopped, and some of it is left for settling
        assert end - start > 0.2 * stand


def test_single_short_pauses_of_a_motion_are_no_stations() -> None:
    t = np.arange(0.0, 60.0, 0.01)
    clock = t - 0.35 * np.clip(np.floor(t / 12.0), 0, None)  # five pauses of 0.35 s
    for k in range(1, 5):
        clock = np.where((t >= 12.0 * k) & (t < 12.0 * k + 0.35), 12.0 * k - 0.35 * (k - 1), clock)
    q = np.stack([np.sin(0.5 * clock + j) for j in range(6)], axis=1)
    assert not len(find_dwells(t, q, StationRules()))


@pytest.mark.parametrize(("count", "most"), [(0, 5), (5, 5), (6, 5), (1000, 999), (24_000, 1000), (300_000, 1000)])
def test_so_many_rows_come_in_order_and_evenly(count: int, most: int) -> None:
    rows = spread_rows(count, most)
    assert len(rows) == min(count, most)
    assert (np.diff(rows) > 0).all()
    gaps = np.diff(np.r_[-1, rows, count])
    assert gaps.max(initial=0) <= 3.0 * max(count / most, 1.0) + 1.0
    assert len(set(gaps[1:-1].tolist())) <= 3


def test_approach_remembers_the_last_way_of_every_joint() -> None:
    approach = Approach()
    assert approach.update(np.zeros(3)).tolist() == [0, 0, 0]
    for x in np.linspace(0.0, 0.1, 50):
        came = approach.update(np.array([x, -x, 1e-5 * x]))
    assert came.tolist() == [1, -1, 0]
    assert approach.update(np.array([0.0998, -0.1, 0.0])).tolist() == [1, -1, 0], "less than noise"
    assert approach.update(np.array([0.0990, -0.1, 0.0])).tolist() == [-1, -1, 0]


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
    return Recording((joint_track(chain.names, t, q),), (ReadingTrack("point", "tracker", s + late, points, s),))


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


@pytest.mark.parametrize(("seed", "jump"), [(167, 0.0), (3, 0.4)])
def test_a_slow_motion_of_a_long_tool_is_no_clock_that_jumps(seed: int, jump: float) -> None:
    """The tip is not what the tracker sees: pieces of a slow motion may agree best at lags of their own."""
    rng, chain, t = np.random.default_rng(seed), ur10(), np.arange(0.0, 90.0, 0.02)
    rate, phase = rng.uniform(0.08, 0.6, (5, chain.n)), rng.uniform(0.0, 2.0 * np.pi, (5, chain.n))
    size = 1.4 * rng.dirichlet(np.ones(5), chain.n).T
    q = np.sum(size[:, None] * np.sin(rate[:, None] * t[:, None] + phase[:, None]), axis=0)
    T = chain_forward(chain, q)
    p = T[:, :3, 3] + T[:, :3, :3] @ [0.05, 0.0, 0.25] + rng.normal(0.0, 3e-5, (len(t), 3))
    seen = ReadingTrack("point", "tracker", t + jump * (t > 50.0), p, t)
    if jump:
        with pytest.raises(BadRecording, match=r"jumps by \+0\.[345]\d s"):
            clock_offset(seen, t, q, lambda x: chain_forward(chain, x))
        return
    clock = clock_offset(seen, t, q, lambda x: chain_forward(chain, x))
    assert clock is not None
    assert not clock.clear
    assert clock.offset == pytest.approx(0.0, abs=2e-3)

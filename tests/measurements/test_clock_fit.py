"""Where clocks agree nobody is told that they do not; where they do not, the delay is told to a fraction of a millisecond.

The tracked point is a hand's length from the tip, which nobody has told the estimator.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from modcal_core.geometry import se3
from modcal_core.measurements.alignment import align, clock_offset, fit_offset
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


@pytest.mark.parametrize("start", [-0.08, 0.0, 0.12])
def test_of_a_slow_motion_the_fit_leaves_a_start_that_is_off(start: float) -> None:
    """Its correlation is flat, and highest where the tip's speed, not the point's, agrees with what was seen."""
    chain = read_chain((ROBOTS / "panda.urdf").read_text())
    rng = np.random.default_rng(0)
    speed, phase = rng.uniform(0.25, 0.5, chain.n), rng.uniform(0.0, 6.0, chain.n)
    step = 0.02
    grid = np.arange(0.0, 60.0, step)
    T = chain_forward(chain, 0.6 * np.sin(grid[:, None] * speed + phase))
    turning = np.gradient(T[:, :3, :3], step, axis=0)
    velocity = np.gradient(T[:, :3, 3], step, axis=0)
    seen = np.linalg.norm(velocity + turning @ np.array(TOOL), axis=1)
    fit = fit_offset(lambda late: np.interp(grid + late, grid, seen), velocity, turning, start, step)
    assert abs(fit.offset) < 1e-3
    assert fit.std < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["panda", "ur10", "xarm7"])
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
        assert found is not None
        off.append(found.offset)
        sure.append(found.std)
    assert np.abs(off).max() < 1e-3
    # the standard deviation is that of these offsets: chi-square of eight, 0.01 % beyond on either side
    assert 0.7 < np.sum((np.array(off) / sure) ** 2) < 35.0


@pytest.mark.parametrize("late", [-0.1, -0.006, 0.006, 0.033])
def test_a_delay_is_found_with_the_point_that_is_seen(late: float) -> None:
    chain = read_chain((ROBOTS / "panda.urdf").read_text())
    recording = cell(chain, 1, late, noise=1e-4)
    aligned, notes = align(recording, chain.names, lambda q: chain_forward(chain, q))
    (note,) = notes
    assert f"was {1e3 * late:+.0f} ms off" in note
    assert np.abs(aligned.readings[0].stamps - recording.readings[0].received).max() < 1e-3

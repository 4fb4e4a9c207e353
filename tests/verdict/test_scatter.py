"""A base, a tool or a while that scatters by far more than the rest is named; joints and instruments are not."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from cells import Recorded, samples_of, ur10
from verdict.visits import said

from modcal_core.calibration.cell import Cell
from modcal_core.calibration.stated import Stated
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples

STAND, SEAT = "scatter of the base", "scatter of the tool"


def moved(made: Recorded, twists: Array, tool: bool) -> Samples:
    """Readings of a tool, or of a base one metre below the tracker's origin, that moves by twists (N, 6)."""
    T = made.world.tool_in_tracker(made.samples.q)
    if tool:
        T = T @ se3.exp(twists)
    else:
        at = np.eye(4)
        at[:3, 3] = T[:, :3, 3].mean(axis=0) - [0.0, 0.0, 0.5]
        T = at @ se3.exp(twists) @ se3.inverse(at) @ T
    out = samples_of(ur10(), made.samples.q, T)
    R = out.R @ so3.exp(2e-5 * np.random.default_rng(8).normal(size=(len(T), 3)))
    return replace(out, reading=out.reading + made.samples.reading - made.exact.reading, R=R)


def twists(turn: float, lever: Array | None = None) -> Array:
    """Turns at random [rad] about any axis, or about one with a lever [m] to the target, (140, 6)."""
    rng = np.random.default_rng(6)
    if lever is None:
        return np.concatenate([np.zeros((140, 3)), turn * rng.normal(size=(140, 3))], axis=1)
    one = np.outer(turn * rng.normal(size=140), [0.6, 0.0, 0.8])
    return np.concatenate([np.cross(one, lever), one], axis=1)


@pytest.mark.slow
def test_a_stand_that_wobbles(made: Recorded) -> None:
    samples = moved(made, twists(5e-4), tool=False)
    text = said(samples)
    assert STAND in text, text
    known = Cell(stated=Stated(repeatability_mm=1.0, repeatability_deg=0.1, instrument_mm=0.09, instrument_deg=0.005))
    assert STAND not in said(samples, known)


@pytest.mark.slow
def test_a_target_that_is_loose_in_its_seat(made: Recorded) -> None:
    text = said(moved(made, twists(3e-3, np.array([0.0, 0.15, 0.05])), tool=True))
    assert SEAT in text, text


@pytest.mark.slow
def test_a_while_in_which_something_shook(made: Recorded) -> None:
    shaken = (np.arange(140) >= 60) & (np.arange(140) < 85)
    off = np.where(shaken, 4.0, 0.0)[:, None] * (made.samples.reading - made.exact.reading)
    text = said(replace(made.samples, reading=made.samples.reading + off))
    first, last = (int(k) for k in re.search(r"At stations (\d+) to (\d+) readings scatter", text).groups())
    assert abs(first - 60) < 4
    assert abs(last - 84) < 4


@pytest.mark.slow
@pytest.mark.parametrize("repeats", [True, False])
def test_what_returns_repeat_is_no_scatter(made: Recorded, repeats: bool) -> None:
    """A wrist that errs by 0.8 mrad at random, the same at every visit of a posture, or another."""
    rng = np.random.default_rng(9)
    visits = np.r_[np.arange(100), rng.permutation(100)[:30]]
    q, actual = made.samples.q[visits], made.samples.q[visits].copy()
    off = 8e-4 * rng.standard_normal(130)
    actual[:, 3] += off[visits] if repeats else off
    T = made.world.tool_in_tracker(actual)
    T[:, :3, 3] += 2e-5 * rng.standard_normal((130, 3))
    T[:, :3, :3] = T[:, :3, :3] @ so3.exp(2e-5 * rng.standard_normal((130, 3)))
    text = said(samples_of(ur10(), q, T))
    assert ("wrist_1_joint scatters by" in text) != repeats, text
    assert ("the motion of joint wrist_1_joint" in text) or not repeats, text

"""A joint that drags a cable, by an ODE of Bouc and Wen: found, told from backlash, and made up for on the way back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from cells import NOISE_M, NOISE_RAD, record, ur10

from modcal_core.correction.compensation import compensate
from modcal_core.correction.correction import ArmState, Correction
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.dwells import Approach
from modcal_core.measurements.path import UNKNOWN, WIDTHS, ahead, went_on
from modcal_core.measurements.samples import Samples

CHAIN = ur10()
J, SIZE, SCALE = 2, 5e-4, 0.4  # elbow, rad, rad


def dragged(path: Array, state: float = 0.0) -> Array:
    """State of the cable, −1 … 1, at each position of a path (T,) that is gone in straight lines."""
    out = np.full(len(path), state)
    for k, way in enumerate(np.diff(path)):
        steps = int(np.ceil(abs(way) / (0.02 * SCALE)))
        for _ in range(steps):
            along = np.sign(way * state)
            state += way / steps / SCALE * (1.0 - abs(state) ** 1.3 * (0.6 * along + 0.4))
        out[k + 1] = state
    return out


def off(q: Array, state: Array) -> Array:
    """Where the joints truly are."""
    there = q.copy()
    there[:, J] -= SIZE * state
    return there


def test_followers_are_those_of_one_step_after_the_other_and_forget_where_they_began() -> None:
    path = np.cumsum(np.random.default_rng(0).normal(0.0, 0.1, (500, 2)), axis=0)
    rows = np.array([0, 7, 250, 499])
    whole = ahead(path, WIDTHS, rows)
    now, seen, live = np.tile(UNKNOWN, (2, 1, 1)), [], Approach()
    for way, q in zip(np.diff(path, axis=0, prepend=path[:1]), path, strict=True):
        now = went_on(now, way)
        seen.append(now)
        live.update(q)
    assert np.abs(whole - np.array(seen)[rows]).max() < 1e-12
    assert np.abs(live.path - whole[-1]).max() < 1e-12
    swept = np.ptp(path, axis=0)[:, None] >= 2.0 * WIDTHS
    assert (np.abs(np.diff(whole[-1], axis=1)[:, 0][swept]) < 1e-12).all()


def test_a_dragged_cable_is_named_and_made_up_for_forth_and_back() -> None:
    made, rng = record(4, 130), np.random.default_rng(5)
    q, world = made.samples.q, made.world
    T = world.tool_in_tracker(off(q, dragged(q[:, J])))
    T[:, :3, 3] += NOISE_M * rng.standard_normal((len(q), 3))
    T[:, :3, :3] = T[:, :3, :3] @ so3.exp(NOISE_RAD * rng.standard_normal((len(q), 3)))
    found = calibrate(Samples.from_arrays(q, poses=T, names=CHAIN.names), CHAIN, np.random.default_rng(0))
    assert [(e.family, e.place) for e in found.report.effects] == [("hysteresis", CHAIN.names[J])]
    correction, way, now = Correction(found.calibration), Approach(), q[-1]
    for each in q:
        way.update(each)
    goals = np.tile([0.3, -1.0, 1.2, -0.5, 1.0, 0.2], (60, 1))
    goals[:, J] += 0.7 * np.sin(np.arange(60) / 4.0)  # forth and back, never far enough to forget
    desired, went, states, gaps = world.tool_in_tracker(goals), q[:, J].tolist(), dragged(q[:, J]), []
    last, plain = states[-1], []
    for goal, T_goal in zip(goals, desired, strict=True):
        at = ArmState.at_rest(now, 1.7e9)
        for path, missed in ((way.path, gaps), (np.empty((0, 0, 0)), plain)):
            sent = compensate(correction, T_goal, goal, replace(at, path=path), "tool", "tracker").q
            reached = dragged(np.array([now[J], sent[J]]), last)[-1:]
            missed.append(np.linalg.norm(world.tool_in_tracker(off(sent[None], reached))[0, :3, 3] - T_goal[:3, 3]))
            if missed is gaps:
                new, state = sent, reached[0]
        now, last = new, state
        way.update(now)
        went.append(now[J])
    rms, without = (float(np.sqrt(np.mean(np.square(x)))) for x in (gaps, plain))
    assert rms < 0.3 * without
    assert rms < 3.0 * NOISE_M

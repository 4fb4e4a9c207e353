"""The fastest timing of a path: against closed forms, a linear program, and MuJoCo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from robots.pick_and_place import SHARE, PickAndPlace
from robots.random_arms import Mujoco, random_urdf
from robots.test_acceleration import arm
from robots.test_kinematics import urdf
from scipy.optimize import linprog

from modcal_core.errors import BadRobot, BadTable, Overloaded
from modcal_core.robots.bodies import Payload, with_payload
from modcal_core.robots.fastest_motion import JointPath, motion, within_bounds, within_torque


@pytest.mark.slow
def test_bang_bang() -> None:
    """One joint, constant bounds: with unequal up and down, T = √(2 L (1/up + 1/down)); at a speed limit, a trapeze."""
    path = JointPath.through([[0.0], [3.0]])
    up, down, fast = 2.0, 5.0, 1.5
    free = within_bounds(path, [-down], [up], [np.inf], 2000)
    assert free.duration == pytest.approx(np.sqrt(2 * 3.0 * (1 / up + 1 / down)), rel=1e-5)
    limited = within_bounds(path, [-down], [up], [fast], 2000)
    ramps = 0.5 * fast**2 * (1 / up + 1 / down)
    assert limited.duration == pytest.approx(fast * (1 / up + 1 / down) + (3.0 - ramps) / fast, rel=1e-3)


@pytest.mark.parametrize("places", [40, 80])
def test_no_timing_is_faster(places: int) -> None:
    """On the same grid, a linear program with all intervals at once: its timing is none the faster, but for the grid."""
    rng = np.random.default_rng(8)
    for _ in range(3):
        path = JointPath.through(np.cumsum(rng.uniform(-0.8, 0.8, (5, 4)), axis=0))
        low, high, fast = -rng.uniform(1, 5, 4), rng.uniform(1, 5, 4), rng.uniform(0.5, 2.0, 4)
        timing = within_bounds(path, low, high, fast, places)
        s = np.linspace(0.0, path.length, places)
        _, dq, ddq = path.at(s)
        step = np.diff(s)
        rows, limits = [], []
        for k in range(places - 1):
            for place in (k, k + 1):
                for j in range(4):
                    row = np.zeros(places)
                    row[k + 1] += dq[place, j] / (2 * step[k])
                    row[k] -= dq[place, j] / (2 * step[k])
                    row[place] += ddq[place, j]
                    rows += [row, -row]
                    limits += [high[j], -low[j]]
        most = ((fast / np.maximum(np.abs(dq), 1e-12)).min(axis=1)) ** 2
        most[[0, -1]] = 0.0
        assert (np.array(rows) @ timing.x <= np.array(limits) + 1e-9).all()
        assert (timing.x <= most + 1e-9).all()
        best = linprog(
            -np.ones(places), A_ub=np.array(rows), b_ub=np.array(limits), bounds=np.c_[np.zeros(places), most]
        )
        assert best.status == 0
        speed = np.sqrt(best.x)
        assert timing.duration <= np.sum(2.0 * step / (speed[1:] + speed[:-1])) * (1.0 + 0.2 / places)


def test_motion_is_consistent() -> None:
    """Positions, velocities and accelerations are derivatives of each other, and it goes from rest to rest."""
    path = JointPath.through(np.random.default_rng(1).uniform(-1, 1, (4, 3)))
    timing = within_bounds(path, -2.0 * np.ones(3), 3.0 * np.ones(3), np.ones(3))
    h = 1e-6
    t = np.random.default_rng(2).uniform(0.05, timing.duration - 0.05, 200)
    before, now, after = (motion(path, timing, t + d) for d in (-h, 0.0, h))
    assert np.abs((after[0] - before[0]) / (2 * h) - now[1]).max() < 1e-4
    smooth = np.abs(after[2] - before[2]).max(axis=1) < 1e-2  # not where the acceleration jumps
    assert smooth.mean() > 0.9
    assert np.abs((after[1] - before[1]) / (2 * h) - now[2])[smooth].max() < 1e-3
    ends = motion(path, timing, np.array([0.0, timing.duration]))
    assert np.abs(ends[0] - path.at(np.array([0.0, path.length]))[0]).max() < 1e-9
    assert np.abs(ends[1]).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_torques_are_used_up_and_not_exceeded(seed: int) -> None:
    """Of a random arm with friction, by MuJoCo's mechanics: nowhere beyond the limit, almost everywhere one at it."""
    rng = np.random.default_rng(seed)
    text = random_urdf(rng, 4, friction=True)
    chain, inertias, drives = arm(text)
    drives = replace(drives, speed=np.full(4, np.inf))
    path = JointPath.through(np.cumsum(rng.uniform(-0.6, 0.6, (4, 4)), axis=0))
    timing = within_torque(chain, inertias, drives, path, places=400)
    t = np.linspace(0.0, timing.duration, 500)[1:-1]
    q, v, a = motion(path, timing, t)
    truth = Mujoco(text, chain)
    friction = drives.viscous * v + drives.coulomb * np.sign(v)
    tau = np.array([truth.torque(*row) for row in zip(q, v, a, strict=True)]) + friction
    use = np.abs(tau / drives.torque)
    assert use.max() < 1.0 + 2e-3  # between grid points the limits are met to second order
    assert np.median(use.max(axis=1)) > 0.97


@pytest.mark.slow
def test_pick_and_place_in_mujoco(rng: np.random.Generator) -> None:
    """Faster than by the constant bounds of the workspace, and of this very path, and no drive is ever asked too much."""
    job = PickAndPlace()
    fast = job.by_torque()
    constant = job.by_constants(job.windows(job.workspace(500, rng), None))
    along = job.by_constants(job.windows(job.path.at(np.linspace(0.0, job.path.length, 60))[0], None))
    assert fast.duration < along.duration < constant.duration
    played = job.play(fast)
    assert (np.abs(played.torque) < job.drives.torque).all()
    assert np.abs(played.torque / job.drives.torque).max() > 0.9 * SHARE  # it is the torque that limits it
    assert played.miss < 0.01
    # the servo alone, with no plan of the torque, is far behind: the plan is what moves it
    slow = job.play(constant)
    assert (np.abs(slow.torque) < job.drives.torque).all()


def test_what_cannot_be_gone() -> None:
    chain, inertias, drives = arm(urdf("ur10"))
    heavy = with_payload(inertias, chain, Payload.checked(60.0))
    path = JointPath.through([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
    with pytest.raises(Overloaded, match="joint elbow_joint at posture .* of the 150 N m"):
        within_torque(chain, heavy, drives, path)
    with pytest.raises(BadRobot, match="effort"):
        within_torque(chain, inertias, replace(drives, torque=np.full(6, np.nan)), path)
    for waypoints, said in (([[0.0]], "shape"), ([[0.0], [np.nan]], "finite"), ([[1.0], [1.0], [2.0]], "1 and 2")):
        with pytest.raises(BadTable, match=said):
            JointPath.through(waypoints)

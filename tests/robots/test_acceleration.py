"""Bounds of accelerations and the fastest timing of a path, as MuJoCo, closed forms and a linear program have them."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace

import numpy as np
import pytest
from robots.pick_and_place import SHARE, PickAndPlace
from robots.random_arms import Mujoco, random_urdf
from robots.test_kinematics import urdf
from scipy.optimize import linprog

from modcal_core.errors import BadRobot, BadTable, Overloaded
from modcal_core.geometry.so3 import Array
from modcal_core.robots.acceleration import Drives, LoadedArm, Window, largest_box, read_drives
from modcal_core.robots.bodies import Payload
from modcal_core.robots.chain import Chain
from modcal_core.robots.fastest_motion import JointPath, motion, within_bounds, within_torque
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import Inertias, read_inertias


def arm(text: str) -> tuple[Chain, Inertias, Drives]:
    chain = read_chain(text)
    return chain, read_inertias(text, chain), read_drives(text, chain)


class Rig:
    """A random arm with friction, postures and speeds, the window they leave, and MuJoCo to tell torques."""

    def __init__(self, seed: int, moving: bool = True) -> None:
        rng = np.random.default_rng(seed)
        text = random_urdf(rng, 5, friction=True)
        self.chain, self.inertias, self.drives = arm(text)
        self.truth = Mujoco(text, self.chain)
        self.q = rng.uniform(-1.5, 1.5, (6, 5))
        self.v = rng.uniform(0.05, 0.5, (6, 5)) * rng.choice([-1.0, 1.0], (6, 5)) * moving
        self.rng = rng
        self.window = LoadedArm(self.chain, self.inertias, self.drives).window(self.q, self.v)

    def torque(self, k: int, a: Array, friction: Array | None = None) -> Array:
        """What the drives give at posture k for accelerations a, by MuJoCo's mechanics and the URDF's friction."""
        damping = self.truth.model.dof_damping[self.truth.at]
        dry = self.truth.model.dof_frictionloss[self.truth.at]
        sign = np.sign(self.v[k]) if friction is None else friction
        return self.truth.torque(self.q[k], self.v[k], a) + dry * sign + damping * self.v[k]


def at_limit(torque: Array, limit: Array) -> Array:
    return np.abs(np.abs(torque) - limit) < 1e-7 * limit


@pytest.mark.parametrize("seed", range(2))
def test_equivalent_bounds_take_all_of_the_drive(seed: int) -> None:
    """One joint at its bound, the others not accelerating: its drive is at its limit, with friction as it moves."""
    rig = Rig(seed)
    for sign, bounds in zip((-1.0, 1.0), rig.window.equivalent(), strict=True):
        for k in range(len(rig.q)):
            for i in range(5):
                a = np.zeros(5)
                a[i] = bounds[k, i]
                assert rig.torque(k, a)[i] == pytest.approx(sign * rig.drives.torque[i], rel=1e-9)


def test_a_standing_joint_may_begin_either_way() -> None:
    rig = Rig(1, moving=False)
    low, high = rig.window.equivalent()
    for i in range(5):
        for bound, way in ((low, -1.0), (high, 1.0)):
            a = np.zeros(5)
            a[i] = bound[0, i]
            assert rig.torque(0, a, np.full(5, way))[i] == pytest.approx(way * rig.drives.torque[i], rel=1e-9)


@pytest.mark.parametrize("seed", range(2))
def test_given_the_others_accelerations(seed: int) -> None:
    """At either end of the interval one drive is at its limit and none beyond; outside, one is beyond."""
    rig = Rig(10 + seed)
    low, high = rig.window.box()
    a = low + rig.rng.random(low.shape) * (high - low)
    ends = rig.window.given(a)
    for k in range(len(rig.q)):
        for i in range(5):
            assert ends[0][k, i] <= a[k, i] <= ends[1][k, i]
            for way, end in zip((-1.0, 1.0), ends, strict=True):
                b = a[k].copy()
                b[i] = end[k, i]
                torque = rig.torque(k, b)
                assert at_limit(torque, rig.drives.torque).sum() >= 1
                assert (np.abs(torque) <= rig.drives.torque * (1.0 + 1e-9)).all()
                b[i] += way * 1e-3
                assert (np.abs(rig.torque(k, b)) > rig.drives.torque).any()


@pytest.mark.parametrize("seed", range(2))
def test_at_every_corner_of_the_box_all_drives_are_within_their_limits(seed: int) -> None:
    rig = Rig(20 + seed)
    low, high = rig.window.box()
    assert (low < 0.0).all()
    assert (high > 0.0).all()
    for k in range(len(rig.q)):
        touched = np.zeros(5, bool)
        for corner in itertools.product((0, 1), repeat=5):
            torque = rig.torque(k, np.where(corner, high[k], low[k]))
            assert (np.abs(torque) <= rig.drives.torque * (1.0 + 1e-9)).all()
            touched |= at_limit(torque, rig.drives.torque)
        assert touched.any()


def test_no_box_is_larger() -> None:
    """At the largest product no other box gains on the whole: Σ w z' / z ≤ Σ w, by linear programming."""
    rng = np.random.default_rng(5)
    for _ in range(20):
        n = int(rng.integers(1, 8))
        m = n + int(rng.integers(0, 10))
        A = rng.normal(size=(m, n)) * 10.0 ** rng.uniform(-3, 3, n)
        lower, upper = -rng.uniform(0.01, 10.0, m), rng.uniform(0.01, 10.0, m)
        w = rng.uniform(0.2, 5.0, n)
        low, high = largest_box(A[None], lower[None], upper[None], w)
        z = np.r_[high[0], -low[0]]
        # written anew: the worst corner of a row takes high where its coefficient is positive, low where it is not
        rows, limits = [], []
        for row, bottom, top in zip(A, lower, upper, strict=True):
            rows += [np.r_[np.where(row > 0, row, 0), np.where(row < 0, -row, 0)]]
            rows += [np.r_[np.where(row < 0, -row, 0), np.where(row > 0, row, 0)]]
            limits += [top, -bottom]
        B, h = np.array(rows), np.array(limits)
        assert (B @ z <= h * (1.0 + 1e-12)).all()
        best = linprog(-np.r_[w, w], A_ub=B * z / h[:, None], b_ub=np.ones(len(h)), bounds=(0, None))
        assert best.status == 0
        assert -best.fun == pytest.approx(2.0 * w.sum(), rel=1e-6)


def test_too_heavy_a_payload_is_said_with_the_joint() -> None:
    chain, inertias, drives = arm(urdf("ur10"))
    q = np.zeros((1, 6))  # stretched out
    w = LoadedArm(chain, inertias, drives, Payload.checked(40.0)).window(q)
    assert not w.held()[0]
    with pytest.raises(
        Overloaded, match=r"joint shoulder_lift_joint: gravity, friction and speed need .* of the 330 N m"
    ):
        w.box()


def test_drives_as_the_urdf_states_them() -> None:
    text = urdf("ur10").replace(
        'effort="150" velocity="3.15"/>', 'effort="150" velocity="0"/><dynamics damping="2" friction="3"/>'
    )
    chain, _, drives = arm(text)
    assert drives.torque.tolist() == [330.0, 330.0, 150.0, 54.0, 54.0, 54.0]
    assert drives.speed.tolist() == [2.16, 2.16, np.inf, 3.2, 3.2, 3.2]
    assert drives.viscous.tolist() == [0.0, 0.0, 2.0, 0.0, 0.0, 0.0]
    assert drives.coulomb[2] == 3.0
    with pytest.raises(ValueError, match="read-only"):
        drives.torque[0] = 1.0
    assert drives.names == chain.names


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('effort="150"', 'effort="0"', "drive of joint elbow_joint: the robot description states no effort"),
        ('effort="150"', 'effort="nan"', "joint elbow_joint: effort: 'nan' is not a number of 0 or more"),
        ('effort="150"', 'effort="strong"', "joint elbow_joint: effort: 'strong'"),
    ],
)
def test_drives_that_cannot_be_used(old: str, new: str, said: str) -> None:
    text = urdf("ur10").replace(old, new)
    chain = read_chain(text)  # kinematics do not mind
    with pytest.raises(BadRobot, match=said):
        LoadedArm(chain, read_inertias(text, chain), read_drives(text, chain)).window(np.zeros((1, 6)))


def test_values_given_by_hand() -> None:
    _, _, drives = arm(urdf("ur10"))
    assert drives.with_values("torque", {"elbow_joint": 99.0}).torque[2] == 99.0
    for value in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(BadRobot, match="torque of joint elbow_joint"):
            drives.with_values("torque", {"elbow_joint": value})
    with pytest.raises(BadRobot, match="torque of joint 'elbow': is not of this arm: name one of shoulder_pan"):
        drives.with_values("torque", {"elbow": 9.0})
    assert drives.with_values("coulomb", {"elbow_joint": 0.0}).coulomb[2] == 0.0


def test_an_arm_without_masses_is_refused() -> None:
    text = re.sub(r"<inertial>.*?</inertial>", "", urdf("ur10"), flags=re.DOTALL)
    chain, inertias, drives = arm(text)
    with pytest.raises(BadRobot, match="joint shoulder_pan_joint: moves nothing that has a mass"):
        LoadedArm(chain, inertias, drives).window(np.zeros((1, 6)))


@pytest.mark.parametrize(("of_y", "of_x"), [(-6.1, None), (-6.0, (-5.0, 10.0)), (8.0, (-5.0, 10.0)), (8.1, None)])
def test_a_joint_that_is_given_too_much_leaves_the_other_nothing(of_y: float, of_x: tuple[float, float] | None) -> None:
    """A gantry of two slides, whose drives do not feel each other: 2 kg and 5 kg, −10 … 20 N and −30 … 40 N."""
    gantry = Window(("x", "y"), np.diag([2.0, 5.0])[None], np.array([[-10.0, -30.0]]), np.array([[20.0, 40.0]]))
    lower, upper = gantry.given([0.0, of_y])
    assert [lower[0, 0], upper[0, 0]] == ([*of_x] if of_x else pytest.approx([np.nan] * 2, nan_ok=True))


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
    timing = within_torque(LoadedArm(chain, inertias, drives), path, places=400)
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
    unknown = replace(drives, torque=np.full(6, np.nan))
    path = JointPath.through([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
    with pytest.raises(Overloaded, match="joint elbow_joint at posture .* of the 150 N m"):
        within_torque(LoadedArm(chain, inertias, drives, Payload.checked(60.0)), path)
    with pytest.raises(BadRobot, match="effort"):
        within_torque(LoadedArm(chain, inertias, unknown), path)
    for waypoints, said in (([[0.0]], "shape"), ([[0.0], [np.nan]], "finite"), ([[1.0], [1.0], [2.0]], "1 and 2")):
        with pytest.raises(BadTable, match=said):
            JointPath.through(waypoints)

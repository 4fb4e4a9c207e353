"""Joints' efforts show the force on the tool, whatever a wrench sensor says; those that are no torques show none."""

from __future__ import annotations

import math

import numpy as np
import pytest
from impedance.toy import PANDA, PERIOD, READY, ROOT

from modcal_core.geometry.so3 import Array
from modcal_core.impedance.joint_force import ArmEfforts, FreeMotion, JointForce
from modcal_core.impedance.task import JointPositions
from modcal_core.impedance.wrench import DOWN
from modcal_core.robots.acceleration import read_drives
from modcal_core.robots.bodies import HeldWeight, chain_gravity_wrench, payload_wrench
from modcal_core.robots.kinematics import pose_and_jacobian
from modcal_core.robots.urdf_inertias import read_inertias

MAX, STANDS = 50.0, 47.5  # N: that may be felt; at which a pull stands
HANGS = 0.7  # kg at the tip, of which the robot description knows nothing
CLENCHED = np.array(
    [1.5, -1.0, 2.0, 0.1, 0.05, -0.1]
)  # N, N m: of the hand about the handle, before anything is pulled


@pytest.fixture(scope="module")
def arm() -> ArmEfforts:
    text = (ROOT / "examples" / "robots" / "panda.urdf").read_text()
    return ArmEfforts(PANDA, read_inertias(text, PANDA), read_drives(text, PANDA).torque)


class Reports:
    """Efforts by the tables of before, with gains, zeros and noise of their own.

    dry: friction that stays, of the full effort. constants: by how much torque constants are off. friction (n,): against
    the speed.
    """

    def __init__(
        self,
        arm: ArmEfforts,
        rng: np.random.Generator,
        dry: float = 0.0,
        constants: float = 0.02,
        friction: float = 0.0,
    ) -> None:
        self.arm, self._rng = arm, rng
        self._gain = 1.0 + rng.uniform(-constants, constants, arm.chain.n)
        self.friction = friction * arm.full * rng.uniform(0.3, 1.0, arm.chain.n)
        self._zero = 0.004 * arm.full * rng.uniform(-1.0, 1.0, arm.chain.n)
        self._dry = dry * arm.full * rng.uniform(-1.0, 1.0, arm.chain.n)

    def at(self, q: Array, wrench: Array, speed: Array | float = 0.0) -> Array:
        chain, bodies = self.arm.chain, self.arm.bodies
        weight = chain_gravity_wrench(chain, bodies, q[None])[:, 5, 0] + HANGS * payload_wrench(chain, q[None])[:, 5, 0]
        true = np.sign(speed) * self.friction - weight - pose_and_jacobian(chain, q)[1].T @ (wrench + CLENCHED)
        return self._gain * true + self._zero + self._dry + 1e-3 * self.arm.full * self._rng.standard_normal(chain.n)


def begun(reports: Reports, scale: float = 1.0, weight: bool = True, motion: FreeMotion | None = None) -> JointForce:
    """A check that has seen the arm stand. scale: of what is reported. weight: whether that has the arm's own in it.

    motion: what was seen before.
    """
    arm = reports.arm
    check = JointForce(arm, DOWN)
    J = pose_and_jacobian(arm.chain, READY)[1]
    own = 0.0 if weight else HeldWeight(arm.chain, arm.bodies).efforts(READY)
    for k in range(30):
        check.rest(JointPositions(READY, k * PERIOD, scale * (reports.at(READY, np.zeros(6)) - own)))
    check.begin(J, motion)
    return check


def shown(check: JointForce, reports: Reports, force: Array, felt: float) -> tuple[float, float | None]:
    """(the force [N] that is shown at least at the end of half a second in which the tool goes some way and a force (3,) [N]
    in the base comes up; the true force at which it stood or was let go, None if never).
    """
    q, start = READY.copy(), 31 * PERIOD
    for k in range(round(0.5 / PERIOD)):
        share = 2.0 * k * PERIOD
        q = READY + share * np.array([0.1, 0.2, -0.1, 0.2, 0.0, 0.1, 0.3])
        T, J = pose_and_jacobian(PANDA, q)
        wrench = np.concatenate([T[:3, :3].T @ (share * force), np.zeros(3)])
        stamp = start + k * PERIOD
        check.take(JointPositions(q, stamp, reports.at(q, wrench)), J)
        says = felt / max(float(np.linalg.norm(force)), 1e-9) * wrench[:3]
        if check.refused(says, stamp, MAX) is not None or check.force > STANDS:
            return check.force, float(share * np.linalg.norm(force))
    return check.force, None


def test_the_weight_of_one_posture_is_that_of_many(arm: ArmEfforts, rng: np.random.Generator) -> None:
    for _ in range(5):
        q = rng.uniform(arm.chain.lower, arm.chain.upper)
        down = rng.standard_normal(3)
        bodies = arm.bodies.pulled(down)
        weight = HeldWeight(arm.chain, bodies)
        np.testing.assert_allclose(
            weight.efforts(q), -chain_gravity_wrench(arm.chain, bodies, q[None])[:, 5, 0], atol=1e-12
        )
        np.testing.assert_allclose(
            weight.of_load(q), -payload_wrench(arm.chain, q[None], bodies.down)[:, 5, 0], atol=1e-12
        )


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_what_a_sensor_hides_is_found_below_the_limit(arm: ArmEfforts, share: float) -> None:
    """Of a sensor that says nothing, or half, whichever way the force acts."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        way = rng.standard_normal(3)
        reports = Reports(arm, rng)
        check = begun(reports)
        assert not check.unusable
        _, let_go = shown(check, reports, 120.0 * way / np.linalg.norm(way), 120.0 * share)
        assert let_go is not None
        assert 0.4 * MAX / (1.0 - share) < let_go < 1.3 * MAX


@pytest.mark.slow
def test_a_sensor_that_says_all_is_believed_and_no_more_is_shown_than_there_is(arm: ArmEfforts) -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        way = rng.standard_normal(3)
        force, let_go = shown(begun(r := Reports(arm, rng)), r, 45.0 * way / np.linalg.norm(way), 45.0)
        assert let_go is None
        assert 0.6 * 45.0 < force < 48.0


def test_what_is_no_torque_is_not_used_and_the_reason_is_said(arm: ArmEfforts, rng: np.random.Generator) -> None:
    currents, weightless = begun(Reports(arm, rng), scale=0.1), begun(Reports(arm, rng), weight=False)
    geared = begun(Reports(arm, rng, dry=0.15))
    for check in (currents, weightless, geared):
        assert "weight takes" in check.unusable or "full effort" in check.unusable
        assert shown(check, Reports(arm, rng), np.array([0.0, 0.0, 200.0]), 0.0) == (0.0, None)
    without = JointForce(arm, DOWN)
    without.begin(pose_and_jacobian(arm.chain, READY)[1])
    assert "no efforts" in without.unusable


@pytest.mark.filterwarnings("error")
def test_nonsense_among_efforts_shows_no_force(arm: ArmEfforts, rng: np.random.Generator) -> None:
    reports = Reports(arm, rng)
    check = begun(reports)
    J = pose_and_jacobian(PANDA, READY)[1]
    for k, effort in enumerate((1e300, -1e300, np.inf, np.nan, 1e5)):
        check.take(JointPositions(READY, 1.0 + k * PERIOD, np.full(arm.chain.n, effort)), J)
        assert check.force == 0.0
        assert not np.isfinite(check.stamp)
        assert check.refused(np.zeros(3), 1.0 + k * PERIOD, MAX) is None


@pytest.mark.slow
def test_friction_that_turns_about_makes_no_force(arm: ArmEfforts) -> None:
    """Gears whose friction bears two hundredths of the full effort one way as the arm stands, and the other as it goes."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        standing, going = Reports(arm, rng, dry=0.02), Reports(arm, rng, dry=0.02)
        check = begun(standing)
        force, let_go = shown(check, going, np.array([0.0, 0.0, 10.0]), 10.0)
        assert let_go is None
        assert force < 20.0


def moved_freely(reports: Reports, seconds: float = 6.0) -> FreeMotion:
    """What was seen of an arm whose joints swing about, each in a time of its own."""
    motion, rate = FreeMotion(), 2.0 * np.pi / np.linspace(2.5, 4.0, reports.arm.chain.n)
    for t in np.arange(0.0, seconds, PERIOD):
        q, v = READY + 0.3 * np.sin(rate * t), 0.3 * rate * np.cos(rate * t)
        motion.take(JointPositions(q, t - 100.0, reports.at(q, -CLENCHED, v)))
    return motion


def test_friction_and_torque_constants_are_learned_from_motions_and_a_force_is_told_within_its_deviation(
    arm: ArmEfforts,
) -> None:
    """In a slow pull against 30 N, with constants that are off by 5 % and friction of up to 3 % of the full effort."""
    worst = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        reports = Reports(arm, rng, constants=0.05, friction=0.03)
        check, way = begun(reports, motion=moved_freely(reports)), rng.standard_normal(3)
        assert not check.unusable
        np.testing.assert_allclose(check._friction, reports.friction, atol=0.006 * arm.full.max())
        v = np.array([0.06, 0.1, -0.05, 0.1, 0.04, 0.06, 0.1])
        for k in range(150):
            q = READY + k * PERIOD * v
            T, J = pose_and_jacobian(PANDA, q)
            wrench = np.concatenate([T[:3, :3].T @ (30.0 * way / np.linalg.norm(way)), np.zeros(3)])
            check.take(JointPositions(q, 1.0 + k * PERIOD, reports.at(q, wrench, v)), J)
        off = check.wrench[:3] - wrench[:3] - CLENCHED[:3]
        worst.append(math.sqrt(off @ np.linalg.solve(check.covariance[:3, :3], off)))
        assert np.linalg.norm(off) < 10.0
    assert max(worst) < 4.0


def test_a_direction_that_no_joint_bears_is_not_told(arm: ArmEfforts, rng: np.random.Generator) -> None:
    """Outstretched, an arm does not feel along itself."""
    check = begun(Reports(arm, rng))
    assert len(check.unseen(MAX)) == 0
    straight = np.array([0.0, 0.0, 0.0, -0.07, 0.0, 0.07, 0.0])
    check._look_up(pose_and_jacobian(PANDA, straight)[1])
    blind = check.unseen(MAX)
    assert len(blind) == 1
    assert abs(blind[0] @ pose_and_jacobian(PANDA, straight)[0][2, :3]) > 0.9

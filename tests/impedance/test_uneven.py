"""Six axes, steps of unequal length, joints that jump, and whether the arm can go all the way."""

from __future__ import annotations

import numpy as np
import pytest
from cells import ur10
from impedance.toy import PANDA, PERIOD, READY, T_READY, door, drawer, limits
from impedance.walking import reach

from modcal_core.errors import BadCommand, NotReachable
from modcal_core.geometry import se3
from modcal_core.geometry.single import speeds
from modcal_core.geometry.so3 import Array
from modcal_core.impedance.safety_monitor import ArmSetpoint, Limits, SafetyMonitor, SensorReadings
from modcal_core.impedance.setpoint_filter import SetpointFilter
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import body_jacobian, chain_forward
from modcal_core.robots.mechanism import inverse


def asked(guard: SafetyMonitor, chain: Chain, q: Array, now: float) -> None:
    """Ask the guard for a posture (n,) at a time, everything else being as it should."""
    T, zero = chain_forward(chain, q), np.zeros(chain.n)
    wish = ArmSetpoint(chain.base, chain.names, T, q, zero, np.zeros(6), np.array([900.0] * 3 + [50.0] * 3))
    joints = dict(zip(chain.names, q.tolist(), strict=True))
    guard.check(wish, SensorReadings(joints, now - 0.001, T, np.zeros(6), chain.tip, now - 0.001), now)


@pytest.mark.slow
@pytest.mark.parametrize(("elbow", "passes"), [(1.2, True), (0.0, False)])
def test_an_arm_of_six_axes_is_kept_from_singular_postures(elbow: float, passes: bool) -> None:
    chain, q = ur10(), np.array([0.3, -1.0, elbow, -1.3, 1.4, 0.2])
    least = np.linalg.svd(body_jacobian(chain, q[None])[0], compute_uv=False)[-1]
    assert (least > 0.02) == passes
    guard = SafetyMonitor(chain, Limits(np.full(6, 1.5), np.full(6, 15.0)))
    guard.open(chain_forward(chain, q), q, 10.0)
    if passes:
        asked(guard, chain, q, 10.004)
    else:
        with pytest.raises(BadCommand, match="next to singular"):
            asked(guard, chain, q, 10.004)


@pytest.mark.slow
@pytest.mark.parametrize(("share", "passes"), [(0.98, True), (1.02, False)])
def test_speeds_of_steps_of_unequal_length_change_between_their_middles(share: float, passes: bool) -> None:
    # 2 ms at rest, then 8 ms at a speed: from the middle of one to the middle of the other pass 5 ms
    bounds = limits()
    speed = share * min(bounds.angular_acceleration, float(bounds.joint_acceleration[6])) * 0.005
    guard = SafetyMonitor(PANDA, bounds)
    guard.open(T_READY, READY, 10.0)
    asked(guard, PANDA, READY, 10.002)
    moved = READY + 0.008 * speed * np.eye(7)[6]
    if passes:
        asked(guard, PANDA, moved, 10.010)
    else:
        with pytest.raises(BadCommand, match="acceleration"):
            asked(guard, PANDA, moved, 10.010)


def test_a_way_on_which_a_joint_would_jump_ends_before_it() -> None:
    turns = np.array([0.0, 0.2, 0.8, 1.0])  # 0.6 rad from one pose to the next; 0.35 are allowed
    poses = np.array([T_READY @ se3.exp([0, 0, 0, 0, 0, a]) for a in turns])
    found = reach(PANDA, poses, READY)
    assert not found.whole
    assert len(found.joints) == 2
    assert "would jump" in found.why
    assert reach(PANDA, poses, READY, stride=0.7).whole


@pytest.mark.parametrize("model", [door(0.4), door(0.3, -1.0), drawer()], ids=["left", "right", "drawer"])
def test_a_way_within_reach_is_found_with_its_joints(model: object) -> None:
    far = 1.05 if model.turns else 0.3  # type: ignore[attr-defined]
    poses = model.pose(np.linspace(0.0, far, 30))  # type: ignore[attr-defined]
    found = reach(PANDA, poses, READY).require()
    assert found.whole
    T = chain_forward(PANDA, found.joints)
    assert np.abs(T[:, :3, 3] - poses[:, :3, 3]).max() < 2e-4
    assert np.abs(T[:, :3, :3] - poses[:, :3, :3]).max() < 2e-3
    assert (found.joints >= PANDA.lower + 0.02).all()
    assert (found.joints <= PANDA.upper - 0.02).all()
    assert np.linalg.svd(body_jacobian(PANDA, found.joints), compute_uv=False).min() >= 0.03
    assert np.abs(np.diff(found.joints, axis=0)).max() < 0.35
    assert np.allclose(found.posture(0.0), found.joints[0])
    assert np.allclose(found.posture(1.0), found.joints[-1])
    assert np.allclose(found.posture(0.5 / 29), found.joints[:2].mean(axis=0))


@pytest.mark.slow
def test_a_way_out_of_reach_says_where_it_ends(rng: np.random.Generator) -> None:
    """Pushed straight away from the base: where the arm is stretched, it says so, and not before."""
    farthest = 1.2
    poses = np.array([se3.transform(p=[x, 0.0, 0.0]) @ T_READY for x in np.linspace(0.0, farthest, 80)])
    found = reach(PANDA, poses, READY)
    assert not found.whole
    assert 10 < len(found.joints) < 79
    assert "%" in found.why
    with pytest.raises(NotReachable):
        found.require("drawer")
    # inverse kinematics from thirty other postures knows no way to the next pose either
    with pytest.raises(NotReachable):
        inverse(PANDA, poses[len(found.joints)], found.joints[-1], rng=rng)


def test_a_joint_that_would_pass_its_limit_is_named() -> None:
    turns = np.linspace(0.0, 4.0, 120)
    poses = np.array([T_READY @ se3.exp([0, 0, 0, 0, 0, a]) for a in turns])
    found = reach(PANDA, poses, READY)
    assert not found.whole
    assert "panda_joint7 reaches its limit of" in found.why
    assert "2.9 rad" in found.why
    assert found.why.startswith(f"{100.0 * len(found.joints) / 119.0:.0f} % of the path")


@pytest.mark.slow
def test_joints_follow_jumps_without_breaking_limits(rng: np.random.Generator) -> None:
    """Goals that jump, ticks that jitter: the guard's limits hold, and the last goal is reached."""
    lim = limits(speed=0.2, acceleration=2.0, angular_speed=1.0, angular_acceleration=10.0)
    follower = SetpointFilter(PANDA, lim)
    follower.begin(READY, T_READY)
    goal, q, T, rates = T_READY, READY, T_READY, np.zeros(3)
    joint_rates, before = np.zeros(7), PERIOD
    for k in range(1200):
        if k % 80 == 0 and k < 800:
            goal = T_READY @ se3.exp(rng.uniform(-1, 1, 6) * [0.1, 0.1, 0.1, 0.3, 0.3, 0.3])
        h = PERIOD * rng.uniform(0.3, 3.0)
        follower.step(goal, h, READY)
        span = min(h, 0.5 * (h + before))
        way, turn = speeds(T, follower.pose)
        assert way <= lim.speed * h
        assert turn <= lim.angular_speed * h
        rate = (follower.pose[:3, 3] - T[:3, 3]) / h
        assert np.linalg.norm(rate - rates) <= lim.acceleration * span
        joints = (follower.q - q) / h
        assert (np.abs(joints) <= lim.joint_speed).all()
        assert (np.abs(joints - joint_rates) <= lim.joint_acceleration * span).all()
        assert np.abs(chain_forward(PANDA, follower.q) - follower.pose).max() < 1e-9
        q, T, rates, joint_rates, before = follower.q, follower.pose, rate, joints, h
    assert speeds(follower.pose, goal)[0] < 1e-4
    assert speeds(follower.pose, goal)[1] < 1e-3


@pytest.mark.slow
def test_a_goal_behind_a_joint_limit_is_not_followed_through_it() -> None:
    follower = SetpointFilter(PANDA, limits())
    follower.begin(READY, T_READY)
    for k in range(1500):
        follower.step(T_READY @ se3.exp([0, 0, 0, 0, 0, min(0.004 * k, 3.0)]), PERIOD)
        assert (follower.q <= PANDA.upper).all()
        assert (follower.q >= PANDA.lower).all()
    assert follower.lag(follower.pose) == 0.0


def test_a_tool_measured_by_something_better_is_led_there() -> None:
    """Where the chain is off by some mm, the offset goes along."""
    off = se3.exp([0.003, -0.002, 0.001, 0.004, 0.0, -0.003])
    follower = SetpointFilter(PANDA, limits())
    follower.begin(READY, off @ T_READY)
    assert np.abs(follower.pose - off @ T_READY).max() < 1e-9
    goal = off @ T_READY @ se3.exp([0.02, 0.0, 0.01, 0.0, 0.05, 0.0])
    for _ in range(500):
        follower.step(goal, PERIOD)
    assert np.abs(off @ chain_forward(PANDA, follower.q) - goal).max() < 1e-4

"""Guards where the usual arm and the usual step do not look: six axes, steps of unequal length, joints that jump."""

from __future__ import annotations

import numpy as np
import pytest
from cells import ur10
from impedance.toy import PANDA, READY, T_READY, limits
from impedance.walking import reach

from modcal_core.errors import BadCommand
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.impedance.safety_monitor import ArmSetpoint, Limits, SafetyMonitor, SensorReadings
from modcal_core.impedance.wrench import Load
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import body_jacobian, chain_forward


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


def test_weight_pulls_at_the_centre_of_mass(rng: np.random.Generator) -> None:
    for _ in range(5):
        mass, centre, R = rng.uniform(0.5, 3.0), rng.uniform(-0.2, 0.2, 3), so3.exp(rng.normal(size=3))
        weight = R.T @ np.array([0.0, 0.0, -mass * 9.80665])
        said = Load(mass, centre).wrench(R)
        assert said[:3] == pytest.approx(weight)
        assert said[3:] == pytest.approx(np.cross(centre, weight))

"""Leads of joints against the softest that they may be: a sensor that says too little, one that is right, and late ones.

The servos here are a torque that grows with the lead, less a first-order lag; of the check's bounds they know nothing.
"""

from __future__ import annotations

import numpy as np
import pytest
from impedance.toy import PANDA, PERIOD, READY

from modcal_core.geometry.so3 import Array
from modcal_core.impedance.joint_lead_check import JointLeadCheck
from modcal_core.robots.kinematics import pose_and_jacobian

LAG, MOST, STIFFEST = 0.03, 50.0, 100e3
TRUE = np.array([4000.0] * 4 + [1000.0] * 3)  # N m/rad
CONTACT = 15e3  # N/m, of a hand at what does not move


def pulled(share: float, least: Array, lag: float = LAG, late: int = 0, speed: float = 7e-3) -> tuple[float, float]:
    """Pulled along x of the tool at what is locked: the true force [N] when it is refused, inf never; most unexplained.

    share: of the force that the sensor tells. lag: of the servos, stated as 0.03 s. late: periods by which references
    are late. speed: of the reference [m/s].
    """
    check = JointLeadCheck(least, LAG, PERIOD)
    J = pose_and_jacobian(PANDA, READY)[1]
    step = np.linalg.pinv(J) @ np.array([speed * PERIOD, 0.0, 0.0, 0.0, 0.0, 0.0])
    compliance, reference, q, most = J @ (J / TRUE).T, READY.copy(), READY.copy(), 0.0
    yields = np.linalg.inv(np.eye(6) + CONTACT * compliance @ np.diag([1.0, 0, 0, 0, 0, 0]))
    sent = [reference] * (late + 1)
    for k in range(1, 4000):
        now = k * PERIOD
        reference = reference + step
        check.sent(reference, now)
        sent.append(reference)
        # where the tool would be without a contact, x; with it, the contact's force F = K x' pulls it back
        x = J @ (sent[-1 - late] - READY)
        force = CONTACT * (yields @ x)[0]
        wrench = np.array([-force, 0.0, 0.0, 0.0, 0.0, 0.0])
        aim = sent[-1 - late] + (J.T @ wrench) / TRUE
        q = q + (aim - q) * PERIOD / (lag + PERIOD)
        check.heard(now - late * PERIOD, now)
        most = max(most, float(check.unexplained(q, now, share * wrench, J).max()))
        if check.refused(q, now, share * wrench, J, MOST, STIFFEST) is not None:
            return force, most
        if force > 200.0:
            break
    return np.inf, most


@pytest.mark.parametrize("share", [0.0, 0.1, 0.2])
def test_a_sensor_that_says_a_fifth_is_found_out_where_the_softest_is_known(share: float) -> None:
    force, _ = pulled(share, TRUE / 1.5)
    assert force < 1.2 * MOST


@pytest.mark.parametrize("softer", [1.0, 1.5, 3.0])
@pytest.mark.parametrize("lag", [0.02, 0.04])
def test_a_sensor_that_tells_all_is_believed(softer: float, lag: float) -> None:
    """Up to 200 N, however little the servos yield, and if their lag is a third off."""
    force, most = pulled(1.0, TRUE / softer, lag)
    assert np.isinf(force)
    assert most < 3e-4


@pytest.mark.parametrize("late", [3, 10])
def test_references_that_are_late_are_no_hidden_force(late: int) -> None:
    force, _ = pulled(1.0, TRUE / 1.5, late=late, speed=0.03)
    assert np.isinf(force)


def test_servos_softer_than_stated_are_taken_for_a_wrong_sensor() -> None:
    force, _ = pulled(1.0, 3.0 * TRUE)
    assert np.isfinite(force)


def test_where_nothing_is_known_nothing_is_said() -> None:
    force, most = pulled(0.0, np.full(7, np.nan))
    assert np.isinf(force)
    assert most == 0.0

"""Leads of joints against the softest that they may be: a sensor that says too little, one that is right, and late ones.

The servos here are a torque that grows with the lead, less a first-order lag; of the check's bounds they know nothing.
"""

from __future__ import annotations

import numpy as np
import pytest
from impedance.toy import PANDA, PERIOD, READY

from modcal_core.geometry.so3 import Array
from modcal_core.impedance.lead_check import JointLeadCheck
from modcal_core.robots.kinematics import pose_and_jacobian

LAG, MAX, STIFFEST = 0.03, 50.0, 100e3
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
        if check.refused(q, now, share * wrench, J, MAX, STIFFEST) is not None:
            return force, most
        if force > 200.0:
            break
    return np.inf, most


@pytest.mark.parametrize("share", [0.0, 0.1, 0.2])
def test_a_sensor_that_says_a_fifth_is_found_out_where_the_softest_is_known(share: float) -> None:
    force, _ = pulled(share, TRUE / 1.5)
    assert force < 1.2 * MAX


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


def met_in_motion(share: float, learned: bool, speeds: tuple[float, float] = (0.03, 0.03)) -> float:
    """A tool that moves freely meets what does not move after half a second: the true force [N] when it is refused.

    share: of the force that the sensor tells. learned: whether the servos' lags are known to a millisecond.
    speeds: of the reference before and after that moment [m/s], gathered at 0.15 m/s².
    """
    check = JointLeadCheck(TRUE / 1.8, LAG, PERIOD)
    if learned:
        check.learned(np.full(7, LAG), np.full(7, 1e-3), np.zeros(7))
    J = pose_and_jacobian(PANDA, READY)[1]
    way = np.linalg.pinv(J) @ np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    compliance, reference, q = J @ (J / TRUE).T, READY.copy(), READY.copy()
    yields = np.linalg.inv(np.eye(6) + CONTACT * compliance @ np.diag([1.0, 0, 0, 0, 0, 0]))
    speed, met = 0.0, np.inf
    for k in range(1, 1000):
        now = k * PERIOD
        speed = min(speed + 0.15 * PERIOD, speeds[0] if now < 0.5 else speeds[1])
        reference = reference + way * (speed * PERIOD)
        check.sent(reference, now)
        at = (J @ (q - READY))[0]
        met = at if np.isinf(met) and now >= 0.5 else met
        force = CONTACT * max((yields @ (J @ (reference - READY) - np.array([min(met, 1e3), 0, 0, 0, 0, 0])))[0], 0.0)
        force = force if now >= 0.5 else 0.0
        wrench = np.array([-force, 0.0, 0.0, 0.0, 0.0, 0.0])
        q = q + (reference + (J.T @ wrench) / TRUE - q) * PERIOD / (LAG + PERIOD)
        check.heard(now, now)
        if check.refused(q, now, share * wrench, J, MAX, STIFFEST) is not None:
            return force
        if force > 150.0:
            break
    return np.inf


@pytest.mark.parametrize("speeds", [(0.03, 0.03), (0.03, 0.06)])
def test_a_jam_in_motion_is_found_out_although_the_sensor_says_a_fifth(speeds: tuple[float, float]) -> None:
    """Also where the hand speeds up as it jams, for a model was just trusted; its lag hides little once it is known."""
    known, unknown = met_in_motion(0.2, True, speeds), met_in_motion(0.2, False, speeds)
    assert known < 0.8 * MAX
    assert known <= unknown < 1.2 * MAX


def test_a_jam_in_motion_that_the_sensor_tells_is_none() -> None:
    assert np.isinf(met_in_motion(1.0, True))


@pytest.mark.parametrize("gather", [0.15, 2.0])
def test_servos_that_follow_by_a_delay_hide_nothing_as_they_set_off_and_brake(gather: float) -> None:
    """They stand while the reference has gone on, and go on while it stands."""
    check = JointLeadCheck(TRUE / 1.8, LAG, PERIOD)
    check.learned(np.full(7, LAG), np.full(7, 1e-3), np.zeros(7))
    J = pose_and_jacobian(PANDA, READY)[1]
    way = np.linalg.pinv(J) @ np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    sent, speed = [READY] * (1 + round(LAG / PERIOD)), 0.0
    for k in range(1, 500):
        now = k * PERIOD
        aim = 0.06 if now % 0.8 < 0.4 else 0.0
        speed += float(np.clip(aim - speed, -2.0 * PERIOD, gather * PERIOD))
        sent.append(sent[-1] + way * (speed * PERIOD))
        check.sent(sent[-1], now)
        check.heard(now, now)
        assert check.refused(sent[-1 - round(LAG / PERIOD)], now, np.zeros(6), J, MAX, STIFFEST) is None


def test_a_reference_that_is_late_now_and_then_is_no_hidden_force() -> None:
    """By up to three periods, while the hand goes as fast as it may and readings come in time."""
    check, rng = JointLeadCheck(TRUE / 1.8, LAG, PERIOD), np.random.default_rng(3)
    check.learned(np.full(7, LAG), np.full(7, 1e-3), np.zeros(7))
    J = pose_and_jacobian(PANDA, READY)[1]
    way = np.linalg.pinv(J) @ np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    sent, q, speed, heard = [READY], READY.copy(), 0.0, 0
    for k in range(1, 500):
        now = k * PERIOD
        speed = min(speed + 0.15 * PERIOD, 0.06)
        sent.append(sent[-1] + way * (speed * PERIOD))
        check.sent(sent[-1], now)
        heard = max(heard, k - int(rng.integers(4)) if k // 25 % 2 else k)  # one never comes before an older one
        q = q + (sent[heard] - q) * PERIOD / (LAG + PERIOD)
        check.heard(now, now)
        assert check.refused(q, now, np.zeros(6), J, MAX, STIFFEST) is None

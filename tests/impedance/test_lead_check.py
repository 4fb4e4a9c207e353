"""Leads of tool and joints against what is felt: wrong sensors are found, right and late ones are believed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from impedance.toy import PANDA, PERIOD, READY

from modcal_core.geometry.so3 import Array
from modcal_core.impedance.lead_check import JointLeadCheck, LeadCheck, Stiffness
from modcal_core.impedance.task import JointPositions
from modcal_core.impedance.tool_force import SensorEvidence
from modcal_core.impedance.unfelt_force import ServoModel
from modcal_core.robots.kinematics import pose_and_jacobian

LAG, MAX = 0.03, 50.0
LEVERS = 0.3  # m²


def known(stiffest: float = 100e3) -> Stiffness:
    return Stiffness.of(15e3, 3000.0, LAG, stiffest)


def pressed(check: LeadCheck, stiffness: float, heard: float, newtons: float = 120.0) -> float:
    """The true force [N] at which it lets go, where a setpoint creeps away from a hand that is held.

    stiffness: of the servos [N/m]. heard: force [N] up to which the sensor follows; beyond, its noise goes on.
    """
    rng, speed = np.random.default_rng(0), 2e-3
    check.sent(np.zeros(3), 0.0)
    for k in range(1, 100_000):
        now = PERIOD * k
        p = np.array([speed * now, 0.0, 0.0])
        force = stiffness * max(speed * (now - LAG), 0.0)
        if force > newtons:
            return math.inf
        check.sent(p, now)
        felt = min(force, heard) + rng.normal(0.0, 0.1)
        check.felt(np.full(6, felt), now)
        if check.refused(np.zeros(3), abs(felt), now, MAX, (LEVERS * abs(felt), LEVERS)) is not None:
            return force
    raise AssertionError


@pytest.mark.parametrize(("stiffness", "heard"), [(20e3, 12.0), (60e3, 1.0), (100e3, 0.0), (100e3, 3.0)])
def test_a_sensor_that_sticks_while_its_noise_goes_on_hides_less_than_1_2_of_what_is_stated(
    stiffness: float, heard: float
) -> None:
    assert pressed(LeadCheck(known()), stiffness, heard) < 1.2 * MAX


@pytest.mark.parametrize("stiffness", [5e3, 20e3, 100e3])
def test_a_sensor_that_follows_is_believed_however_soft_the_arm(stiffness: float) -> None:
    assert pressed(LeadCheck(known()), stiffness, math.inf, newtons=48.0) == math.inf


def test_a_sensor_that_repeats_itself_longer_than_ever_is_stuck() -> None:
    """Sent twice each: that is how this driver is. Then it says the same for a tenth of a second."""
    check, rng = LeadCheck(known()), np.random.default_rng(0)
    readings = [r for _ in range(150) for r in 2 * [rng.normal(0.0, 0.2, 6)]]
    held = [readings[-1]] * 30
    for k, raw in enumerate(readings + held):
        assert not check.stuck or k > len(readings) + 20
        check.felt(raw, PERIOD * k)
        check.sent(np.array([1e-4 * k, 0.0, 0.0]), PERIOD * k)
    assert check.stuck
    refused = check.refused(check._sent[-1][1], 5.0, PERIOD * k, MAX)
    assert refused is not None
    assert "to the last digit" in str(refused)


def test_a_coarse_sensor_on_an_arm_that_stands_is_not_stuck() -> None:
    """It says whole newtons, and something new at each as the arm shakes while it moves; then the arm stands."""
    check, rng = LeadCheck(known()), np.random.default_rng(0)
    for k in range(2000):
        moves = k < 1000
        check.felt(np.round(3.0 + rng.normal(0.0, 2.0 if moves else 0.01, 6)), PERIOD * k)
        check.sent(np.array([1e-4 * min(k, 1000), 0.0, 0.0]), PERIOD * k)
        assert not check.stuck


STIFFEST = 100e3  # N/m
TRUE = np.array([4000.0] * 4 + [1000.0] * 3)  # N m/rad
CONTACT = 15e3  # N/m, of a hand at what does not move


def pulled(
    share: float,
    least: Array = TRUE / 1.8,
    lag: float = LAG,
    learned: bool = False,
    free: float = 0.0,
    speeds: tuple[float, float] = (7e-3, 7e-3),
) -> tuple[float, float]:
    """Pulled along x of the tool at what is locked, or jams: the true force [N] when it is refused, inf never; most unexplained.

    share: of the force that the sensor tells. lag: of the servos, stated as 0.03 s. learned: whether their lags are known
    to a millisecond. free: until then the tool moves freely [s]. speeds: of the reference before and after that [m/s],
    gathered at 0.15 m/s².
    """
    check = JointLeadCheck(least, LAG, PERIOD)
    if learned:
        check.learned(np.full(7, LAG), np.full(7, 1e-3), np.zeros(7))
    J = pose_and_jacobian(PANDA, READY)[1]
    along = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    way, compliance = np.linalg.pinv(J) @ along, J @ (J / TRUE).T
    yields = np.linalg.inv(np.eye(6) + CONTACT * compliance @ np.diag(along))
    reference, q, speed, met, most, force = READY.copy(), READY.copy(), 0.0, np.inf, 0.0, 0.0
    for k in range(1, 4000):
        now = k * PERIOD
        speed = min(speed + 0.15 * PERIOD, speeds[0] if now < free else speeds[1])
        reference = reference + way * (speed * PERIOD)
        check.sent(reference, now)
        if now >= free:
            met = (J @ (q - READY))[0] if np.isinf(met) else met
            # where the tool would be without a contact; with it, the contact's force F = K x' pulls it back
            force = CONTACT * max((yields @ (J @ (reference - READY) - met * along))[0], 0.0)
        wrench = -force * along
        q = q + (reference + (J.T @ wrench) / TRUE - q) * PERIOD / (lag + PERIOD)
        check.heard(now, now)
        most = max(most, float(check.unexplained(q, now, -share * J.T @ wrench).max()))
        if check.refused(JointPositions(q, now), -share * J.T @ wrench, share * force, J, MAX, STIFFEST) is not None:
            return force, most
        if force > 200.0:
            break
    return np.inf, most


@pytest.mark.parametrize("share", [0.0, 0.1, 0.2])
def test_a_sensor_that_says_a_fifth_is_found_out_where_the_softest_is_known(share: float) -> None:
    force, _ = pulled(share, TRUE / 1.5)
    assert force < 1.2 * MAX


@pytest.mark.slow
@pytest.mark.parametrize(("softer", "lag"), [(1.0, 0.02), (3.0, 0.04)])
def test_a_sensor_that_tells_all_is_believed(softer: float, lag: float) -> None:
    """Up to 200 N, however little the servos yield, and if their lag is a third off."""
    force, most = pulled(1.0, TRUE / softer, lag)
    assert np.isinf(force)
    assert most < 3e-4


@pytest.mark.parametrize("speeds", [(0.03, 0.03), (0.03, 0.06)])
def test_a_jam_in_motion_is_found_out_although_the_sensor_says_a_fifth(speeds: tuple[float, float]) -> None:
    """Also where the hand speeds up as it jams, for a model was just trusted; its lag hides little once it is known."""
    known, unknown = (pulled(0.2, learned=learned, free=0.5, speeds=speeds)[0] for learned in (True, False))
    assert known < 0.8 * MAX
    assert known <= unknown < 1.2 * MAX


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
        late = JointPositions(sent[-1 - round(LAG / PERIOD)], now)
        assert check.refused(late, np.zeros(7), 0.0, J, MAX, STIFFEST) is None


LEAST, STIFF = np.full(3, 2000.0), np.full(3, 4000.0)  # N m/rad
ARMS = np.array([0.5, 0.3, 0.1])  # m
USUAL, EXPLORING, CREEP = 0.06, 0.03, 0.01  # m/s


def learned(share: float, rng: np.random.Generator, moments: int = 40) -> tuple[float, float] | None:
    """What a sensor that tells a share of the force makes servos seem to yield, of what they may."""
    model = ServoModel(np.full(3, 1e-3), 0.03)
    for _ in range(moments):
        load, speed = rng.uniform(2.0, 10.0) * ARMS, rng.uniform(0.0, 0.1, 3)
        lead = 0.025 * speed + load / STIFF + rng.normal(0.0, 2e-5, 3)
        model.learn(np.stack([speed, share * load + rng.normal(0.0, 0.02, 3), np.ones(3), lead], axis=1))
    model.solve()
    return model.softness(ARMS, LEAST)


def going_on(evidence: SensorEvidence, force: float, way: float, since: float = 0.0) -> None:
    for at in np.linspace(since, since + way, 20):
        evidence.take(force, float(at), False)


def test_what_is_felt_while_the_tool_stands_tells_nothing() -> None:
    """In a jam any sensor tells something in the end, and fingers yield by some millimetres."""
    jam, free = SensorEvidence(known=False), SensorEvidence(known=False)
    going_on(jam, 12.0, 2.5e-3)
    going_on(free, 12.0, 4e-3)
    assert not jam.told
    assert free.told
    assert jam.exploring(0.1, EXPLORING, CREEP) < free.exploring(0.1, EXPLORING, CREEP) == EXPLORING


def test_a_sensor_that_tells_all_is_corroborated_by_servos_that_are_stiffer_than_the_softest(
    rng: np.random.Generator,
) -> None:
    evidence = SensorEvidence(known=True)
    going_on(evidence, 5.0, 4e-3)
    assert not evidence.corroborated
    evidence.learned(learned(1.0, rng))
    assert evidence.corroborated
    assert evidence.refused() is None
    assert evidence.following(USUAL, EXPLORING, CREEP) == USUAL


@pytest.mark.parametrize("share", [0.1, 0.2, 0.35])
def test_a_sensor_that_tells_a_part_makes_servos_softer_than_they_may_be(
    share: float, rng: np.random.Generator
) -> None:
    evidence = SensorEvidence(known=True)
    going_on(evidence, 5.0, 4e-3)
    softness = learned(share, rng)
    evidence.learned(softness)
    assert softness[0] == pytest.approx(LEAST[0] / STIFF[0] / share, rel=0.15)
    assert not evidence.corroborated
    assert evidence.following(USUAL, EXPLORING, CREEP) == EXPLORING
    assert "max_joint_lead_rad" in str(evidence.refused())

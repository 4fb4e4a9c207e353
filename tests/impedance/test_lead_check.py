"""A felt force explains a lead only as far as the servos were seen to yield while the sensor followed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from modcal_core.impedance.lead_check import LeadCheck, Stiffness

PERIOD, LAG, MAX = 0.004, 0.03, 50.0
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


@pytest.mark.parametrize("stiffness", [20e3, 60e3, 100e3])
@pytest.mark.parametrize("heard", [0.0, 1.0, 3.0, 12.0])
def test_a_sensor_that_sticks_while_its_noise_goes_on_hides_less_than_1_2_of_what_is_stated(
    stiffness: float, heard: float
) -> None:
    assert pressed(LeadCheck(known()), stiffness, heard) < 1.2 * MAX


@pytest.mark.parametrize("stiffness", [5e3, 20e3, 100e3])
def test_a_sensor_that_follows_is_believed_however_soft_the_arm(stiffness: float) -> None:
    assert pressed(LeadCheck(known()), stiffness, math.inf, newtons=48.0) == math.inf


def test_what_a_force_explains_goes_with_the_levers_of_the_posture() -> None:
    """The same 20 N, where they or their moment move the tool four times as far."""
    check = LeadCheck(known())
    pressed(check, 60e3, math.inf, newtons=20.0)
    tool = check._sent[-1][1] - [1.2e-3, 0.0, 0.0]
    for _k in range(40):  # it stands
        check.sent(check._sent[-1][1], check._sent[-1][0] + PERIOD)
    stamp = check._sent[-1][0]
    assert check.unfelt(tool, 20.0, stamp, MAX, (LEVERS * 20.0, LEVERS)) > 0.5 * MAX
    assert check.unfelt(tool, 20.0, stamp, MAX, (4.0 * LEVERS * 20.0, LEVERS)) < 0.2 * MAX


def test_a_stiffer_arm_creeps_slower() -> None:
    assert LeadCheck(known(300e3)).creep(MAX) == pytest.approx(LeadCheck(known(100e3)).creep(MAX) / 3.0)
    assert LeadCheck(known(0.0)).creep(MAX) == math.inf


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

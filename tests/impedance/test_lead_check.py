"""A felt force explains a lead only as far as the servos were seen to yield while the sensor followed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from modcal_core.impedance.lead_check import LeadCheck, Stiffness

PERIOD, LAG, MOST = 0.004, 0.03, 50.0
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
        if check.refused(np.zeros(3), abs(felt), now, MOST, (LEVERS * abs(felt), LEVERS)) is not None:
            return force
    raise AssertionError


@pytest.mark.parametrize("stiffness", [20e3, 60e3, 100e3])
@pytest.mark.parametrize("heard", [0.0, 1.0, 3.0, 12.0])
def test_a_sensor_that_sticks_while_its_noise_goes_on_hides_less_than_1_2_of_what_is_stated(
    stiffness: float, heard: float
) -> None:
    assert pressed(LeadCheck(known()), stiffness, heard) < 1.2 * MOST


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
    assert check.unfelt(tool, 20.0, stamp, MOST, (LEVERS * 20.0, LEVERS)) > 0.5 * MOST
    assert check.unfelt(tool, 20.0, stamp, MOST, (4.0 * LEVERS * 20.0, LEVERS)) < 0.2 * MOST


def test_a_stiffer_arm_creeps_slower() -> None:
    assert LeadCheck(known(300e3)).creep(MOST) == pytest.approx(LeadCheck(known(100e3)).creep(MOST) / 3.0)
    assert LeadCheck(known(0.0)).creep(MOST) == math.inf

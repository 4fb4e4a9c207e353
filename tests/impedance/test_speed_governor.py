"""Pace: as fast as a hard stop allows, by a stop that is worked out step by step; and forces that are foreseen."""

from __future__ import annotations

import math

import numpy as np
import pytest

from modcal_core.impedance.speed_governor import ForcePrediction, GovernorSettings, SpeedGovernor

_STEP = 1e-5  # s
_BRAKE = 2.0  # m/s²


def stopped(speed: float, delay: float, stiffness: float, force: float) -> float:
    """The force [N] at the end: at a speed into a spring, as before for a delay, and then braking."""
    t, x, v = 0.0, 0.0, speed
    while v > 0.0:
        if t >= delay:
            v = max(v - _BRAKE * _STEP, 0.0)
        x += v * _STEP
        t += _STEP
    return force + stiffness * x


@pytest.mark.parametrize("force", [0.0, 8.0, 30.0])
@pytest.mark.parametrize("delay", [0.0, 0.05, 0.3])
@pytest.mark.parametrize("stiffness", [2e3, 15e3, 80e3])
def test_at_the_speed_in_sight_a_hard_stop_comes_to_just_the_last_force(
    stiffness: float, delay: float, force: float
) -> None:
    settings = GovernorSettings(max_force=50.0, contact_stiffness=stiffness)
    speed = SpeedGovernor(settings, brake=_BRAKE).in_sight(force, delay)
    assert speed > 0.0
    assert stopped(speed, delay, stiffness, force) == pytest.approx(
        settings.max_force, abs=2.0 * stiffness * speed * _STEP
    )


@pytest.mark.parametrize("force", [50.0, 51.0, 1e6])
def test_at_the_last_force_nothing_is_in_sight(force: float) -> None:
    assert SpeedGovernor(GovernorSettings()).in_sight(force, 0.05) == 0.0


def test_a_force_that_rises_steadily_is_foreseen() -> None:
    """F = r t along one direction, and a moment that falls: F + r s and the moment as it is."""
    foresight, rate, ahead = ForcePrediction(), 700.0, 0.06
    along, about = np.array([2.0, -1.0, 2.0]) / 3.0, np.array([0.0, 0.6, 0.8])
    for k in range(1, 60):
        t = 0.002 * k
        F = np.concatenate([rate * t * along, (9.0 - 20.0 * t) * about])
        seen = foresight.ahead(F, t, ahead)
    assert seen[:3] == pytest.approx(rate * (t + ahead) * along, rel=1e-3)
    assert seen[3:] == pytest.approx(F[3:])


def test_foresight_sees_no_more_than_there_is() -> None:
    """A force that stands, or is none, is what it is, for whatever time ahead; a reading heard twice says no more."""
    foresight = ForcePrediction()
    F = np.array([3.0, 4.0, 0.0, 0.0, 0.0, 0.0])
    for k in range(100):
        seen = foresight.ahead(F, 0.004 * k, 10.0)
    assert seen == pytest.approx(F)
    assert (ForcePrediction().ahead(np.zeros(6), 1.0, 10.0) == 0.0).all()
    foresight = ForcePrediction()
    foresight.ahead(F, 1.0, 0.1)
    once = foresight.ahead(2.0 * F, 1.01, 0.1)
    assert np.linalg.norm(once[:3]) > 10.0
    assert foresight.ahead(2.0 * F, 1.01, 0.1) == pytest.approx(once)


def test_braking_goes_on_by_its_way() -> None:
    """v t is what v²/2a is."""
    pace = SpeedGovernor(GovernorSettings(), brake=_BRAKE)
    pace.speed = 0.06
    t, way = pace.braking, 0.0
    while pace.speed > 0.0:
        way += pace.step(0.0, math.inf, np.zeros(6), _STEP)
    assert way == pytest.approx(0.06 * t, rel=1e-3)
    assert math.isclose(pace.braking, 0.0)


@pytest.mark.parametrize(("force", "most"), [(44.0, 0.02), (44.0, 4e-3), (20.0, 0.02), (47.5, 0.02)])
def test_the_slower_of_what_is_felt_and_what_is_in_sight_counts_and_not_both(force: float, most: float) -> None:
    """Up to 30 N the whole speed, none from 47.5 N on; a lower limit is no reason to go at a share of it."""
    pace, F = SpeedGovernor(GovernorSettings()), np.array([0.0, 0.0, force, 0.0, 0.0, 0.0])
    for _ in range(1000):
        way = pace.step(0.03, most, F, 0.004)
    share = min(1.0, (47.5 - force) / (47.5 - 30.0))
    assert way / 0.004 == pytest.approx(min(0.03 * share, most))


def test_late_inputs_slow_down_at_once_and_for_a_while() -> None:
    pace = SpeedGovernor(GovernorSettings())
    pace.heed(0.11, 0.004)
    assert pace.caution == pytest.approx(3.0)
    for _ in range(1000):  # four seconds
        way = pace.step(0.03, math.inf, np.zeros(6), 0.004)
        pace.heed(0.01, 0.004)
    assert way / 0.004 == pytest.approx(0.03, rel=0.01)

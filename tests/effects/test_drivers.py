"""What effects act on: lagging sensors, signals that hold until the next message, and what is remembered of samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, ur10
from scipy.integrate import solve_ivp

from modcal_core.calibration.model import place_model
from modcal_core.effects.drivers import _LAST, Drivers, NominalArm, delayed, remembered
from modcal_core.measurements.recording import SignalTrack, is_told

LAG = 120.0  # s


def _warming(t: np.ndarray) -> np.ndarray:
    """A motor that warms up, and a hall whose doors open now and then."""
    return np.asarray(22.0 + 15.0 * (1.0 - np.exp(-t / 1500.0)) + 1.5 * np.sin(2.0 * np.pi * t / 900.0))


def _sensed(t: np.ndarray) -> np.ndarray:
    """What a sensor of that lag shows, by integrating its equation."""
    answer = solve_ivp(
        lambda now, x: (_warming(np.array(now)) - x) / LAG, (t[0], t[-1]), [22.0], t_eval=t, rtol=1e-8, atol=1e-8
    )
    return np.asarray(answer.y[0])


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["into the lag", "out of it"])
def test_a_lag_is_applied_or_undone(sign: float) -> None:
    t = np.arange(0.0, 3600.0, 1.0)
    given, wanted = (_warming(t), _sensed(t)) if sign > 0.0 else (_sensed(t), _warming(t))
    at = t[600:-60]
    found = delayed(t, given, sign * LAG, at)
    left = np.abs(found - np.interp(at, t, wanted)).max()
    as_it_was = np.abs(np.interp(at, t, given) - np.interp(at, t, wanted)).max()
    assert as_it_was > 1.0
    assert left < 0.05 * as_it_was


KG = "signal:/payload_kg"


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ([0.0, 2.5], True),
        ([0.0, 1.0, 2.5, 1.0, 4.0], True),
        (np.float32([0.1, 2.35, 0.1]).astype(float), True),
        ([20.1, 20.4, 20.9, 21.2, 21.6, 21.9, 22.1, 22.5, 22.7, 23.0, 23.3, 23.5, 23.8, 24.0, 24.2, 24.5], True),
        (20.0 + 0.1 * np.arange(60.0), False),  # round, and sampled so often that nothing jumps
        (np.linspace(0.0, 1.0, 7) ** 2 + 1e-5 * np.sqrt(2.0), False),  # jumps, and no round number
        ([3.0, 3.0, 3.0], False),
        ([5.0], False),
        (np.repeat([0.0, 2.0, 1.0], 200), False),  # told every second: there is nothing between two messages
    ],
)
def test_round_numbers_that_jump_are_told(values: list[float], told: bool) -> None:
    assert is_told(np.array(values)) == told


def payload(t: list[float], kg: list[float], moving: bool = False) -> list[float]:
    """The driver at stations 100 s apart."""
    samples = record(1, 6).samples
    samples = replace(
        samples, stamps=1000.0 + 100.0 * np.arange(6), moving=np.full(6, moving),
        signals=(SignalTrack(KG, np.array(t), np.array(kg)[:, None], "/payload_kg"),),
    )  # fmt: skip
    return Drivers(samples, NominalArm(ur10())).values(KG).tolist()


def test_a_payload_holds_until_the_next_message() -> None:
    assert payload([950.0, 1250.0, 1390.0], [0.0, 2.5, 1.0]) == [0.0, 0.0, 0.0, 2.5, 1.0, 1.0]
    assert payload([1250.0, 950.0], [2.5, 0.0]) == [0.0, 0.0, 0.0, 2.5, 2.5, 2.5]
    assert payload([700.0], [2.5]) == [2.5] * 6  # said once


def test_a_message_just_behind_its_station_belongs_to_it_unless_the_arm_moves() -> None:
    behind = [999.9997, 1200.0004, 1400.0004], [0.0, 2.5, 1.0]
    assert payload(*behind) == [0.0, 0.0, 2.5, 2.5, 1.0, 1.0]
    assert payload(*behind, moving=True) == [0.0, 0.0, 0.0, 2.5, 2.5, 1.0]


def test_a_signal_that_was_told_may_lag() -> None:
    """A heater that is switched on: what it heats follows."""
    samples = record(1, 6).samples
    samples = replace(
        samples, stamps=1000.0 + 100.0 * np.arange(6),
        signals=(SignalTrack("signal:/heater", np.array([900.0, 1150.0, 1600.0]), np.array([[0.0], [1.0], [0.0]]), ""),),
    )  # fmt: skip
    found = Drivers(samples, NominalArm(ur10())).values("signal:/heater", 80.0)
    since = np.maximum(samples.stamps - 1150.0, 0.0)
    np.testing.assert_allclose(found, 1.0 - np.exp(-since / 80.0), atol=2e-3)


def test_what_a_sensor_saw_is_interpolated() -> None:
    assert payload([1000.0, 1500.0], [0.123456789, 1.987654321])[1] == pytest.approx(0.4962962954)


def test_drivers_are_remembered_within_the_context_alone() -> None:
    """Of the same samples and the same arm; other samples of the same numbers are others."""
    samples = record(0, 20).samples
    model = place_model(ur10(), samples.frames)
    with remembered():
        first = model.drivers(samples)
        assert model.drivers(samples) is first
        assert model.drivers(replace(samples)) is not first
        assert place_model(ur10(), samples.frames).drivers(samples) is not first
        for _ in range(_LAST):
            model.drivers(replace(samples))
        assert model.drivers(samples) is not first  # memory holds but the last few
    assert model.drivers(samples) is not model.drivers(samples)

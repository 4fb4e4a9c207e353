"""A signal is taken through a first-order lag, or out of one, as the equation of such a sensor says."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from modcal_core.effects.drivers import delayed

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

"""The two descents of a camera calibration: damped Gauss-Newton steps, and a search of few values with few calls.

The sizes of a fit's errors are those that make the data likeliest, looked for with few calls: each costs a solution of
all equations, and far more than what is decided between. The curvature along each axis is measured once, so that the
first step is about as long as it has to be; what the axes have to do with each other comes from the steps (Nocedal &
Wright 2006, §6.1). Next to the minimum, as from one fit to the next, that is 2 n + 1 calls.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

import numpy as np

from modcal_core.geometry import Array

_FIRST, _LEAST, _MOST = 1e-6, 1e-12, 1e7  # damping, relative to the curvature of each value; at the last no step helps


class Descending(Protocol):
    """Where a descent stands."""

    @property
    def cost(self) -> float:
        """Of the place."""


_P = TypeVar("_P", bound=Descending)


def damped(
    here: _P, stepped: Callable[[_P, float], _P | None], met: float, share: float, steps: int
) -> tuple[_P, bool]:
    """(the place where the cost is least, whether it met) by damped Gauss-Newton steps from here.

    stepped: the place a step with this damping farther, None for one that is not possible. met, share: gain of the last
    step, absolute and relative to the cost. steps: at most.
    """
    damping = _FIRST
    for _ in range(steps):
        there = stepped(here, damping)
        if there is not None and there.cost <= here.cost + met:
            gain, here = here.cost - there.cost, there
            damping = max(0.1 * damping, _LEAST)
            if gain <= met + share * max(here.cost, 1e-30):
                return here, True
        else:
            damping = max(10.0 * damping, _FIRST)
            if damping > _MOST:
                return here, True
    return here, False


_APART = 0.02  # of calls that measure the curvature: far above rounding, far below one
_NEXT = 1e-4  # of calls that measure a slope where the curvature is known
_FARTHEST = 1.0  # step of a value: nothing is known of what lies beyond
_ENOUGH = 1e-4  # share of the decrease that the slope promises (Armijo); the usual number
_SHORTEST = 1e-3  # share of a step below which there is no lower place along it


def downhill(
    of: Callable[[Array], float], start: Array, low: Array, high: Array, least_curvature: Array, met: float, most: int
) -> Array:
    """Where ``of`` is least, (n,), within low and high (n,).

    least_curvature: second derivative that is taken for each value where less was measured, (n,). met: how much lower
    it may get with the next step. most: calls after which no step is begun.
    """
    x = np.clip(start, low, high)
    n, value = len(x), of(x)
    up, down = (np.array([of(x + way * axis) for axis in np.eye(n)]) for way in (_APART, -_APART))
    slope = (up - down) / (2.0 * _APART)
    inverse = np.diag(1.0 / np.maximum((up - 2.0 * value + down) / _APART**2, least_curvature))
    calls = 2 * n + 1
    while calls < most:
        free = ~(((x <= low) & (slope > 0.0)) | ((x >= high) & (slope < 0.0)))
        curvature = np.linalg.inv(inverse)
        step = np.zeros(n)
        step[free] = -np.linalg.solve(curvature[np.ix_(free, free)], slope[free])
        if -0.5 * float(slope @ step) < met:
            break
        step *= min(1.0, _FARTHEST / float(np.abs(step).max()))
        share = 1.0
        while share >= _SHORTEST:
            there = np.clip(x + share * step, low, high)
            value_there = of(there)
            calls += 1
            if value_there <= value + _ENOUGH * float(slope @ (there - x)):
                break
            promised = share * float(slope @ step)  # where a parabola through both is least
            share *= float(np.clip(-0.5 * promised / (value_there - value - promised), 0.1, 0.5))
        else:
            break
        moved = there - x
        x, value = there, value_there
        ahead = np.array([of(x + _NEXT * axis) for axis in np.eye(n)])
        calls += n
        new = (ahead - value) / _NEXT - 0.5 * _NEXT * np.diag(curvature)
        inverse = _learnt(inverse, moved, new - slope)
        slope = new
    return x


def _learnt(inverse: Array, moved: Array, by: Array) -> Array:
    """The inverse curvature (n, n) after a step (n,) along which the slope changed by so much (n,)."""
    along = float(moved @ by)
    if along <= 0.0:
        return inverse
    across = np.eye(len(moved)) - np.outer(moved, by) / along
    return np.asarray(across @ inverse @ across.T + np.outer(moved, moved) / along)

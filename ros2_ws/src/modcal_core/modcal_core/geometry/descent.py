"""Damped Gauss–Newton steps (Levenberg 1944, Marquardt 1963): the one solver of all fits.

What is fitted may be anything, a vector or a model: only costs and steps are asked for. A cost may change from step to
step, where weights or scales are found again: a step has to lead downhill by those of the place that it begins from.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from modcal_core.geometry.so3 import Array

# Damping, relative to the curvature along each value: the first of a step that led uphill, the least, far above
# rounding, and one with which a step moves nothing
FIRST_DAMPING, MIN_DAMPING, _MAX_DAMPING = 1e-4, 1e-12, 1e7
_SLACK = 1e-7  # share of the cost that is rounding
_IDLE = 3  # steps in a row that gain no more than that: the cost is as low as its derivatives can tell

P = TypeVar("P")


@dataclass(frozen=True)
class Descent(Generic[P]):
    """Where it ended, steps taken, and whether by itself, not because there were too many."""

    place: P
    steps: int
    converged: bool


def descend(
    begin: P,
    look: Callable[[P], float],
    step: Callable[[P, float], tuple[P, float] | None],
    ended: Callable[[P, float, float], bool],
    most: int,
) -> Descent[P]:
    """The place where the cost is least, from this one downhill.

    look: cost of a place, from which steps then begin. step: the place a step with this damping farther, and its cost;
    None where it is impossible. ended: asked after each step: where it led, what it gained, and the cost before. most:
    steps.
    """
    here, damping, idle = begin, MIN_DAMPING, 0
    for count in range(1, most + 1):
        cost = look(here)
        rounding = _SLACK * abs(cost) + 1e-12
        while (there := step(here, damping)) is None or there[1] > cost + rounding:
            damping = max(10.0 * damping, FIRST_DAMPING)
            if damping > _MAX_DAMPING:
                return Descent(here, count, True)
        here, gain = there[0], cost - there[1]
        idle = idle + 1 if gain <= rounding else 0
        if ended(here, gain, cost) or idle >= _IDLE:
            return Descent(here, count, True)
        damping = max(0.1 * damping, MIN_DAMPING)
    return Descent(here, most, False)


def combined(columns: Array, of: Array) -> Array:
    """By how much each of the columns (n, K) counts where together they are nearest to others (n, …), (K, …).

    Least squares; columns may have units of their own.
    """
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    return np.asarray((np.linalg.lstsq(columns / scale, of, rcond=1e-9)[0].T / scale).T)

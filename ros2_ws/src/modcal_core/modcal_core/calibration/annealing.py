"""Simulated annealing as CN114571465B describes it, to stand beside least squares.

All parameters are shaken at once, ``X' = X + step (rand − 0.5)``; a better X' is taken, a worse one with probability
``exp(−(f(X') − f(X)) / T)`` (Metropolis). After so many trials the temperature falls by a factor, and the next ones
begin at the best X so far. It ends at the last temperature. Derivatives are not asked for, and nothing is said of what
the data cannot tell.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from modcal_core.geometry.so3 import Array


@dataclass(frozen=True)
class Schedule:
    """step: width of the shaking, in the parameters' units. trials: at each temperature. first, last: temperatures, in
    the unit of f. cooling: factor from one to the next. most: temperatures at the most.
    """

    step: float = 1e-3
    trials: int = 60
    first: float = 1e-4
    last: float = 1e-7
    cooling: float = 0.93
    most: int = 1000


@dataclass(frozen=True)
class Annealed:
    """The best X that was met (P,), f there, how often f was asked for, and the best f after each temperature."""

    X: Array
    f: float
    evaluations: int
    history: tuple[float, ...]


def anneal(
    f: Callable[[Array], float],
    start: Array,
    rng: np.random.Generator,
    schedule: Schedule | None = None,
    lower: Array | None = None,
    upper: Array | None = None,
) -> Annealed:
    """The lowest f that the walk from a start (P,) meets. lower, upper: bounds (P,) that X is drawn in to.

    f may be infinite where X makes no robot.
    """
    plan = schedule or Schedule()
    low = np.full(len(start), -np.inf) if lower is None else lower
    high = np.full(len(start), np.inf) if upper is None else upper
    best = here = np.array(start, dtype=float)
    best_f = here_f = f(here)
    evaluations, temperature = 1, plan.first
    history: list[float] = []
    while temperature >= plan.last and len(history) < plan.most:
        for _ in range(plan.trials):
            tried = np.clip(here + plan.step * (rng.random(len(here)) - 0.5), low, high)
            tried_f = f(tried)
            evaluations += 1
            if tried_f <= here_f or rng.random() < np.exp(-(tried_f - here_f) / temperature):
                here, here_f = tried, tried_f
                if here_f <= best_f:
                    best, best_f = here, here_f
        history.append(best_f)
        here, here_f = best, best_f
        temperature *= plan.cooling
    return Annealed(best, best_f, evaluations, tuple(history))

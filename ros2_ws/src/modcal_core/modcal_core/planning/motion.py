"""How an arm goes from one station to the next: a free way, at a limited speed, and when to stop on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from modcal_core.geometry import Array

_STEP = 0.02  # rad or m between two postures of a way that are checked
_OVER = 60  # postures that a way may lead over, nearest first, when the straight one is not free
_PERIOD = 0.1  # s between two points of a trajectory
_PEAK = 1.875  # of the mean speed: the fastest moment of a smooth step (a quintic)

Free = Callable[[Array], np.ndarray]


@dataclass(frozen=True)
class TimedMotion:
    """t: [s] from its beginning, rising, (k,). q, v: postures and joint speeds there, (k, n); at rest at its end."""

    t: Array
    q: Array
    v: Array

    @property
    def end(self) -> Array:
        """Where it ends, (n,)."""
        return np.asarray(self.q[-1])

    def at(self, t: float) -> Array:
        """Joint positions (n,) at a time [s] after the start."""
        return np.array([np.interp(t, self.t, column) for column in self.q.T])


def is_free(a: Array, b: Array, free: Free) -> bool:
    """Whether the straight way between two postures (n,) is free, both ends included."""
    count = max(int(np.ceil(np.abs(b - a).max() / _STEP)), 1)
    # ends and middle first: what is not free is mostly seen there
    share = np.linspace(0.0, 1.0, count + 1)
    coarse = share[:: max(count // 8, 1)]
    way = a + np.multiply.outer(np.r_[coarse, 1.0], b - a)
    return bool(free(way).all()) and bool(free(a + np.multiply.outer(share, b - a)).all())


def free_way(start: Array, goal: Array, free: Free, over: Array) -> list[Array] | None:
    """Postures from the start to the goal (n,), straight lines between them being free; None where none is found.

    over: free postures (m, n) that the way may lead over, one of them, where it cannot be straight.
    """
    if is_free(start, goal, free):
        return [start, goal]
    detour = np.abs(over - start).max(axis=1) + np.abs(goal - over).max(axis=1)
    for k in np.argsort(detour, kind="stable")[:_OVER]:
        if is_free(start, over[k], free) and is_free(over[k], goal, free):
            return [start, over[k], goal]
    return None


def from_side(goal: Array, approach: Array, amount: float = 0.05) -> Array:
    """A posture (n,) from which each joint goes to the goal in the wanted way: −1, 0 (any) or 1, (n,)."""
    return np.asarray(goal - amount * approach)


def timed(way: list[Array], speed: Array) -> TimedMotion:
    """The motion along these postures, at rest at each, no joint faster than its speed (n,) [rad/s, m/s]."""
    t, q, v = [0.0], [way[0]], [np.zeros_like(way[0])]
    for a, b in pairwise(way):
        duration = max(_PEAK * float(np.max(np.abs(b - a) / speed)), 2.0 * _PERIOD)
        count = int(np.ceil(duration / _PERIOD))
        begin = t[-1]
        for k in range(1, count + 1):
            u = k / count
            t.append(begin + u * duration)
            q.append(a + (b - a) * (10.0 * u**3 - 15.0 * u**4 + 6.0 * u**5))
            v.append((b - a) * 30.0 * u**2 * (1.0 - u) ** 2 / duration)
    return TimedMotion(np.array(t), np.array(q), np.array(v))

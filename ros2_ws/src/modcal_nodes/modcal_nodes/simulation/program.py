"""Where the simulated arm is going: smooth travel between postures, with time to stand still."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from functools import partial

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.planning.returns import with_returns
from modcal_core.robots.mechanism import Mechanism, passable

_TRIALS = 1000  # postures that are drawn for one that a Delta can go to
_BRAKE = 0.25  # s in which an arm that is sent elsewhere loses the speed it had


class Program:
    """Postures to pass, each by a certain time, in between on a fifth-order course that starts and ends at rest.

    A program that replaces another while the arm moves takes over its velocity and lets it fade within a quarter of a
    second, also on a fifth-order course, so neither position nor velocity jump.
    """

    def __init__(self, start: Array) -> None:
        """Stand at a posture (n,) from the beginning."""
        self._times = [0.0]
        self._postures = [np.array(start, dtype=float)]
        self._begun, self._brake = 0.0, _BRAKE
        self._carried = np.zeros_like(self._postures[0])
        self._carries = False

    def reset(self, now: float, legs: Sequence[tuple[float, Array]]) -> None:
        """Forget the rest; from now on be at each posture (n,) by its time [s], in order."""
        here, carried = self.state(now)
        self._times = [now, *(t for t, _ in legs)]
        self._postures = [here, *(np.array(q, dtype=float) for _, q in legs)]
        self._begun, self._carried, self._carries = now, carried, bool(carried.any())
        self._brake = min(_BRAKE, self._times[1] - now) if legs else _BRAKE

    def extend(self, legs: Sequence[tuple[float, Array]], done: float) -> None:
        """Add legs behind the last one, and forget those that lie before a time [s] that nobody asks for again."""
        past = max(bisect_right(self._times, done) - 1, 0)
        self._times = [*self._times[past:], *(t for t, _ in legs)]
        self._postures = [*self._postures[past:], *(np.array(q, dtype=float) for _, q in legs)]

    @property
    def end(self) -> float:
        """When the last posture is reached [s]."""
        return self._times[-1]

    def at(self, now: float) -> Array:
        """The posture (n,) at a time [s]."""
        return self.state(now)[0]

    def state(self, now: float) -> tuple[Array, Array]:
        """The posture (n,) at a time [s], and its derivative (n,) [1/s]."""
        i = bisect_right(self._times, now)
        if i == 0:
            return self._postures[0], self._carried
        if i == len(self._times):
            q, v = self._postures[-1], np.zeros_like(self._carried)
        else:
            span = self._times[i] - self._times[i - 1]
            share = (now - self._times[i - 1]) / span
            way = self._postures[i] - self._postures[i - 1]
            q = self._postures[i - 1] + share**3 * (10.0 - 15.0 * share + 6.0 * share**2) * way
            v = (30.0 / span) * (share * (1.0 - share)) ** 2 * way
        if self._carries:
            share = (now - self._begun) / self._brake
            if share >= 1.0:
                return q, v
            # zero at both ends, slope 1 at the first, no curvature at either
            q = q + self._brake * (share - share**3 * (6.0 - 8.0 * share + 3.0 * share**2)) * self._carried
            v = v + (1.0 - share**2 * (18.0 - 32.0 * share + 15.0 * share**2)) * self._carried
        return q, v


def tour(
    chain: Mechanism, count: int, travel: float, dwell: float, rng: np.random.Generator, returns: int = 0
) -> list[tuple[float, Array]]:
    """Legs that visit random postures (travel, then stand still), for :meth:`Program.reset` at time zero.

    returns: how many of the postures are visited a second time on the way, see :func:`with_returns`.
    """
    span = np.where(chain.revolute, 1.2, 0.3)
    low, high = np.maximum(chain.lower, -span), np.minimum(chain.upper, span)
    middle = np.clip(0.0, chain.lower, chain.upper)
    postures: list[Array] = []
    last = middle
    for _ in range(count):
        for _ in range(_TRIALS):
            q = np.where(low < high, rng.uniform(np.minimum(low, high), np.maximum(low, high)), middle)
            if passable(chain, last, q):
                break
        else:
            q = last
        last = q
        postures.append(q)
    order = with_returns(np.array(postures), returns, partial(passable, chain)).order
    legs: list[tuple[float, Array]] = []
    for k, station in enumerate(order):
        arrive = k * (travel + dwell) + travel
        legs += [(arrive, postures[station]), (arrive + dwell, postures[station])]
    return legs

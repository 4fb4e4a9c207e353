"""Where the simulated arm is going: smooth travel between postures, with time to stand still."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain


class Program:
    """Postures to pass, each by a certain time, in between on a fifth-order course that starts and ends at rest."""

    def __init__(self, start: Array) -> None:
        """Stand at a posture (n,) from the beginning."""
        self._times = [0.0]
        self._postures = [np.array(start, dtype=float)]

    def reset(self, now: float, legs: Sequence[tuple[float, Array]]) -> None:
        """Forget the rest; from now on be at each posture (n,) by its time [s], in order."""
        here = self.at(now)
        self._times = [now, *(t for t, _ in legs)]
        self._postures = [here, *(np.array(q, dtype=float) for _, q in legs)]

    @property
    def end(self) -> float:
        """When the last posture is reached [s]."""
        return self._times[-1]

    def at(self, now: float) -> Array:
        """The posture (n,) at a time [s]."""
        i = int(np.searchsorted(self._times, now, side="right"))
        if i == 0:
            return self._postures[0]
        if i == len(self._times):
            return self._postures[-1]
        share = (now - self._times[i - 1]) / (self._times[i] - self._times[i - 1])
        blend = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        return self._postures[i - 1] + blend * (self._postures[i] - self._postures[i - 1])


def tour(chain: Chain, count: int, travel: float, dwell: float, rng: np.random.Generator) -> list[tuple[float, Array]]:
    """Legs that visit random postures (travel, then stand still), for :meth:`Program.reset` at time zero."""
    span = np.where(chain.revolute, 1.2, 0.3)
    low, high = np.maximum(chain.lower, -span), np.minimum(chain.upper, span)
    middle = np.clip(0.0, chain.lower, chain.upper)
    legs: list[tuple[float, Array]] = []
    for k in range(count):
        q = np.where(low < high, rng.uniform(np.minimum(low, high), np.maximum(low, high)), middle)
        arrive = k * (travel + dwell) + travel
        legs += [(arrive, q), (arrive + dwell, q)]
    return legs

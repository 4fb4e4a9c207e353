"""How fast to go on along a path, and whether anything moves at all.

A force that rises slows the pace down before it becomes too much: full speed up to ``slow``, none from ``most`` on.
With the damping B of the impedance law, something that does not give way is then pushed with the force at which B times
the pace is that force, whatever the arm's stiffness.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from modcal_core.geometry.so3 import Array


@dataclass(frozen=True)
class Patience:
    """slow, most: force [N] and moment [N m] at which the pace begins to fall, and at which it is zero.

    still_m: way [m] that counts as having moved. still_s: how long nothing may move under nearly the most force, or
    with the expected pose ``lead`` [m] ahead [s]. give_up_s: or under any force.
    """

    slow: tuple[float, float] = (15.0, 6.0)
    most: tuple[float, float] = (35.0, 14.0)
    still_m: float = 0.002
    still_s: float = 1.0
    give_up_s: float = 8.0
    lead: float = 0.08

    def share(self, F: Array) -> float:
        """Share of the full speed, 0 … 1, at a force and moment F (6,)."""
        force, moment = math.sqrt(F[:3] @ F[:3]), math.sqrt(F[3:] @ F[3:])
        left = [
            (most - value) / (most - slow)
            for value, slow, most in zip((force, moment), self.slow, self.most, strict=True)
        ]
        return min(max(min(left), 0.0), 1.0)


class Pace:
    """The speed along the path [m/s], which gathers gently and brakes hard."""

    def __init__(self, patience: Patience, gather: float = 0.15, brake: float = 2.0) -> None:
        """Standing. gather, brake: [m/s²]."""
        self.patience, self._gather, self._brake = patience, gather, brake
        self.speed = 0.0
        self._mark = (math.nan, 0.0)

    def step(self, wanted: float, F: Array, h: float) -> float:
        """The way [m] to go on in h seconds, where a speed is wanted [m/s] and a force F (6,) is met."""
        aim = wanted * self.patience.share(F)
        self.speed = min(max(aim, self.speed - self._brake * h), self.speed + self._gather * h)
        return self.speed * h

    def stand(self, now: float) -> None:
        """Stand; patience begins anew."""
        self.speed = 0.0
        self._mark = now, self._mark[1]

    def stuck(self, way: float, lead: float, F: Array, now: float) -> bool:
        """Whether nothing has moved for too long: way, measured along the path, and lead of the expected pose [m]."""
        since, mark = self._mark
        if not math.isfinite(since) or abs(way - mark) > self.patience.still_m:
            self._mark = now, way
            return False
        pushed = self.patience.share(F) < 0.25 or lead > self.patience.lead
        return now - since > (self.patience.still_s if pushed else self.patience.give_up_s)

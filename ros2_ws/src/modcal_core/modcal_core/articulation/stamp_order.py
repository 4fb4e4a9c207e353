"""Whether the stamp of a pose follows those before it, or is one of another time.

One stamp that is seconds ahead, or behind, is a fault of whoever stamped it, and must not wipe what was learned. When
the next one goes on from there, time itself has changed: ahead it is a pause, behind a recording that begins again.
"""

from __future__ import annotations

import math
from typing import Literal

_LEAP = 1.0  # s beyond the time that passed between two arrivals
Order = Literal["next", "late", "alone", "restart"]


class StampOrder:
    """The stamps so far. last: of the last pose that was taken, −inf before [s]."""

    def __init__(self) -> None:
        self.last = -math.inf
        self._heard = -math.inf
        self._alone: float | None = None

    def judge(self, stamp: float, heard: float) -> Order:
        """What to do with a pose of a stamp [s] that arrived at ``heard`` on a clock that only goes on [s].

        next: take it. late: older than the last by less than a second, leave it out. alone: it leaps, and the next has
        to say whether that is the time now; leave it out. restart: time has restarted; forget, and take it.
        """
        gap = stamp - self.last
        leaps = not -_LEAP <= gap <= _LEAP + max(heard - self._heard, 0.0) if math.isfinite(self.last) else False
        if leaps:
            alone, self._alone = self._alone, stamp
            together = alone is not None and stamp >= alone and (stamp > self.last) == (alone > self.last)
            if not together:
                return "alone"
        elif gap < 0.0:
            return "late"
        self.last, self._heard, self._alone = stamp, heard, None
        return "restart" if leaps and gap < 0.0 else "next"

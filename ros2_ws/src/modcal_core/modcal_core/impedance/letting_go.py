"""When a release ends."""

from __future__ import annotations

import math
from collections import deque

from modcal_core.geometry.so3 import Array

_USUAL, _LONGEST = 0.6, 1.9  # s; after a second the safety monitor forbids what goes beyond its limits, as ever
_LATELY = 0.1  # s over which it is seen whether the tool still moves
_STANDS = 2e-5  # m by which it then still moves at most: what 8 N do that unwind within two seconds, on stiff fingers


class LettingGo:
    """End of a release. A stiff arm on soft fingers unwinds slowly, so it takes longer while the tool still moves."""

    def __init__(self) -> None:
        self._past: deque[tuple[float, Array]] = deque()

    def over(self, seconds: float, tool: Array) -> bool:
        """Whether the release has ended after this time [s], with the tool measured here (3,) [m]."""
        self._past.append((seconds, tool))
        while self._past[0][0] < seconds - _LATELY:
            self._past.popleft()
        stands = math.dist(self._past[0][1], tool) <= _STANDS
        return seconds > _LONGEST or (seconds > _USUAL and stands)

"""How far a handle has come, by its poses, and how many steps of computation are due for it.

Evidence grows with the path, not with the number of poses on it: each centimetre gets the same number of steps, whether
fifty poses fell on it or one. Noise is no path: only what lies beyond the last mark counts.
"""

from __future__ import annotations

import math
import statistics
from collections import deque

from modcal_core.geometry.so3 import Array

_MARK = 4e-3  # m from mark to mark
_NOISE = 4.0  # deviations of noise on an axis from mark to mark, where that is more
_PER_STEP = 1e-3  # m: a hand at 5 cm/s, seen 50 times a second, makes one step due at each pose
_MOST = 60  # steps at one pose, some 40 ms: more than a whole round
_AHEAD = 5.0  # steps that may be computed before they are due
_LATER = round(_MARK / _PER_STEP)  # steps that may be computed a pose or some later
_STEPS = 7  # of the last poses, whose median is the usual step


class Travel:
    """path: way from mark to mark [m]. step: from one pose to the next, the usual one [m, rad], zeros before there are
    some.
    """

    def __init__(self) -> None:
        self.path = 0.0
        self.step = (0.0, 0.0)
        self._mark: Array | None = None
        self._owed = 0.0
        self._steps: deque[tuple[float, float]] = deque(maxlen=_STEPS)

    def stepped(self, far: float, turn: float) -> None:
        """Note a step [m, rad] from one pose to the next that was accepted."""
        self._steps.append((far, turn))
        self.step = (statistics.median(s[0] for s in self._steps), statistics.median(s[1] for s in self._steps))

    def come(self, p: Array, noise: float) -> None:
        """Take a position (3,) [m] that was accepted. noise: of one, on an axis [m]."""
        if self._mark is None:
            self._mark = p
        far = math.dist(p, self._mark)
        if far >= max(_MARK, _NOISE * noise):
            self._mark = p
            self.path += far
            self._owed += far / _PER_STEP

    def steps_due(self) -> int:
        """How many steps of computation are due at this pose, by the path since the last; one, while few are ahead.

        No more than the usual motion from pose to pose makes due, where no more than from mark to mark is left over:
        what falls due at a mark is spread over the poses up to the next one.
        """
        owed, usual = round(self._owed), math.ceil(self.step[0] / _PER_STEP)
        due = min(max(min(owed, usual), owed - _LATER, int(self._owed > -_AHEAD)), _MOST)
        self._owed = max(self._owed - due, -_AHEAD)
        return due

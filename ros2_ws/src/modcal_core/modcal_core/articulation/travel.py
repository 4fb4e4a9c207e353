"""How far a handle has come, by its poses, and how many steps of computation are due for it.

Evidence grows with the path, not with the number of poses on it: each centimetre gets the same number of steps, whether
fifty poses fell on it or one. Noise is no path: only what lies beyond the last mark counts. An arm that flies by is no
handle that is pulled: in a second no more steps are made than a quick pull asks for.
"""

from __future__ import annotations

import math
import statistics
from collections import deque

from modcal_core.geometry.so3 import Array

_MARK = 4e-3  # m from mark to mark
_NOISE = 4.0  # deviations of noise on an axis from mark to mark, where that is more
_PER_STEP = 1e-3  # m: a hand at 5 cm/s, seen 50 times a second, makes one step due at each pose
_MAX = 60  # steps at one pose, some 40 ms: more than a whole round
_A_SECOND = 250.0  # steps, an eighth of a processor: what a hand at 25 cm/s makes due; a faster one is learned later
_AHEAD = 5.0  # steps that may be computed before they are due
_STEPS = 7  # of the last poses, whose median is the usual step


class Travel:
    """path: way from mark to mark [m]. step: from one pose to the next, the usual one [m, rad], zeros before there are
    some. doubly: whether each millimetre is worth two steps.
    """

    def __init__(self) -> None:
        self.path, self.doubly = 0.0, False
        self.step = (0.0, 0.0)
        self._mark: Array | None = None
        self._owed = 0.0
        self._allowed, self._stamp = float(_MAX), -math.inf
        self._steps: deque[tuple[float, float]] = deque(maxlen=_STEPS)

    @property
    def _per_step(self) -> float:
        return 0.5 * _PER_STEP if self.doubly else _PER_STEP

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
            self._owed += far / self._per_step

    def steps_due(self, stamp: float) -> int:
        """How many steps of computation are due at this pose, by the path since the last; one, while few are ahead.

        stamp: of the pose [s].

        No more than the usual motion from pose to pose makes due, where no more than from mark to mark is left over:
        what falls due at a mark is spread over the poses up to the next one: as much as a mark is worth may come later.
        """
        self._allowed = min(self._allowed + _A_SECOND * max(stamp - self._stamp, 0.0), _MAX)
        self._stamp = stamp
        owed, usual = round(self._owed), math.ceil(self.step[0] / self._per_step)
        most, least = int(self._allowed), int(self._owed > -_AHEAD)
        due = max(min(max(min(owed, usual), owed - round(_MARK / self._per_step)), most), least)
        self._allowed = max(self._allowed - due, 0.0)
        self._owed = min(max(self._owed - due, -_AHEAD), _MAX)
        return due

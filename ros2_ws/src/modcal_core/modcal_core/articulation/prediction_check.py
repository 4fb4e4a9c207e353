"""Whether a model predicts: kept as it was, and asked again when the handle has come as far ahead as it must be right.

A parameter that settles proves nothing: a line settles nicely on the first centimetres of a circle. Way earns trust:
models are kept once twice the distance ahead is known, and the predictions that count lie apart. After each path that
was left, the next has to be known that much farther: what is no joint looks like one for a while, again and again.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from modcal_core.articulation.models.axis import AxisMotion
from modcal_core.geometry import Array

POSITIONS = (1.0, 1e9)  # noise that makes positions alone decide on a configuration
_OFTEN = 0.1  # of the distance ahead: how often a model is kept
_MAX = 12  # models that are kept: somewhat more than lie in the distance ahead
_ABSURD = 25.0  # tolerances: a gross outlier says nothing of the model
_KNOWN = 2.0  # times the distance ahead: path that must be known before a model is kept
_EARLY = 0.2  # of the distance ahead: how much sooner the pose that is nearest may be asked, where poses come seldom
_APART = 0.35  # of the distance ahead: path between the frontiers of two right predictions that make trust


@dataclass(frozen=True, eq=False)
class _FrontierModel:
    """A model as it was when the handle had come to a frontier. until: its configuration at which to ask.

    frontier: path [m] at which it was kept; ahead: how far ahead it is asked [m].
    """

    motion: AxisMotion
    side: float  # direction in which the frontier was passed
    until: float
    frontier: float
    ahead: float


class PredictionCheck:
    """trusted: the last predictions were right, over some path. error: of the last one [m], nan before."""

    def __init__(self, ahead_m: float, ahead_rad: float, tolerance_m: float, changes: int = 0) -> None:
        """changes: how often the path was left before; after each as much more of it must be known."""
        self._known = _KNOWN * (1 + changes)
        self._ahead_m, self._ahead_rad, self._tolerance = ahead_m, ahead_rad, tolerance_m
        self._kept: deque[_FrontierModel] = deque(maxlen=_MAX)
        self._right: tuple[float, float] | None = None  # side and frontier [m] of the first of right ones in a row
        self._range = [0.0, 0.0]
        self._before: Array | None = None
        self.trusted = False
        self.error = math.nan

    def begin(self, low: float, high: float) -> None:
        """Call the path between low and high [m] known: from its ends on, models are kept and asked."""
        step = 1.01 * _OFTEN * self._ahead_m
        self._range = [low + step, high - step]

    def lose(self) -> None:
        """Withdraw trust until predictions earn it again."""
        self.trusted, self._right = False, None

    def doubt(self, motion: AxisMotion, a: float) -> None:
        """Withdraw trust; predictions beyond configuration a, in either direction, are checked again."""
        self.trusted = False
        self._kept.clear()
        self._right = None
        path = a * motion.length_per_unit
        self._range = [path, path]

    def look(self, motion: AxisMotion, a: float, p: Array) -> None:
        """Ask models whose time has come with the pose at p (3,) [m], configuration a; keep this one farther on."""
        length = motion.length_per_unit
        ahead = min(self._ahead_m, self._ahead_rad * length if motion.turns else math.inf)
        step = 0.0 if self._before is None else math.dist(p, self._before)
        self._before = p
        early = min(0.5 * step, _EARLY * ahead)
        for side in (1.0, -1.0):
            kept = next((k for k in self._kept if k.side == side), None)  # the one whose time comes first
            if kept is None:
                continue
            b, e = kept.motion.placed(p, None, POSITIONS)
            if kept.side * (b - kept.until) * kept.motion.length_per_unit >= -early:
                self._kept.remove(kept)
                self._learn(kept, math.sqrt(e @ e))
        for side, end in ((1.0, 1), (-1.0, 0)):
            if side * (a * length - self._range[end]) > _OFTEN * ahead:
                self._range[end] = a * length
                known = self._range[1] - self._range[0] >= self._known * ahead
                if known and not any(k.motion is motion and k.side == side for k in self._kept):
                    self._kept.append(
                        _FrontierModel(motion, side, a + side * ahead / max(length, 1e-6), a * length, ahead)
                    )

    def _learn(self, kept: _FrontierModel, error: float) -> None:
        if error > _ABSURD * self._tolerance:
            return
        self.error = error
        if error > self._tolerance:
            self._right = None
            self.trusted = self.trusted and error <= 2.0 * self._tolerance
        elif self._right is None or self._right[0] != kept.side:
            self._right = kept.side, kept.frontier
        elif kept.side * (kept.frontier - self._right[1]) >= _APART * kept.ahead:
            self.trusted = True

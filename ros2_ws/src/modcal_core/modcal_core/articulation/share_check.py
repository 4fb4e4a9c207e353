"""Whether the model of a good half of the path predicts the rest of it, asked again as the path grows.

A prediction of the next five centimetres says little once half a metre is known: there every smooth path is right. So
the part that was not used for the fit grows with the path. Models are kept as they were along the path; the one from
three fifths of it must say all that came since, within the tolerance or the share of the path by which furniture may
miss (``held_out``), beside noise. Models are thinned out when there are many, so that work and memory stay bounded.

On a short path a model of another joint type, which has been given up since, says nothing against the one that took its
place: a door's first decimetre is a slide.
"""

from __future__ import annotations

import math

import numpy as np

from modcal_core.articulation.held_out import MAY_MISS
from modcal_core.articulation.misfit import rms
from modcal_core.articulation.models.axis import AxisMotion
from modcal_core.articulation.prediction_check import POSITIONS
from modcal_core.articulation.stretches import Stretches
from modcal_core.articulation.track import Track
from modcal_core.geometry.so3 import Array

_FITTED = 0.6  # of the path: a model from there has as much again to say, less a third
_NOISE = 3.0  # deviations of noise beside what is tolerated, as for tracks
_KEPT_EVERY = 0.01  # m of path between models that are kept, at first
_MAX = 64  # of them: on a metre one each 2 cm
_ASKED_EVERY = 0.02  # m of path
_WHOLE = 0.3  # m of path from which the type must have been right as well
_MIN = 3  # stretches that are asked


class ShareCheck:
    """fails: whether the model from three fifths of the path misses the rest, as of the last question.

    stretches: the path so far.
    """

    def __init__(self, tolerance_m: float) -> None:
        self.fails = False
        self._tolerance = tolerance_m
        self.stretches = Stretches()
        self._kept: list[tuple[float, AxisMotion | None]] = []
        self._every, self._asked = _KEPT_EVERY, 0.0

    def come(self, p: Array, motion: AxisMotion | None, noise: float) -> None:
        """Take a position (3,) [m] and the motion that is selected there. noise: of one position, on an axis [m]."""
        self.stretches.come(p, noise)
        path = self.stretches.path
        if not self._kept or path - self._kept[-1][0] >= self._every:
            if len(self._kept) == _MAX:
                self._kept, self._every = self._kept[::2], 2.0 * self._every
            self._kept.append((path, motion))
        if path - self._asked >= _ASKED_EVERY:
            self._asked = path
            self._ask(path, motion, noise)

    def _ask(self, path: float, now: AxisMotion | None, noise: float) -> None:
        way, motion = next((kept for kept in reversed(self._kept) if kept[0] <= _FITTED * path), (0.0, None))
        points = self.stretches.beyond(way)
        if motion is None or len(points) < _MIN:
            return
        if path < _WHOLE and now is not None and now.kind != motion.kind:
            self.fails = False
            return
        rest = Track.trusted(points)
        off = rms(np.linalg.norm(motion.residuals(rest, motion.configurations(rest, POSITIONS))[:, :3], axis=1))
        self.fails = off > math.hypot(max(self._tolerance, MAY_MISS * path), _NOISE * noise)

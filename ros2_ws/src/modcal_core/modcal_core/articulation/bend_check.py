"""Whether what a joint leaves of the path so far is one smooth bend, asked again as the path grows: no joint, then.

As for tracks (``bends``), and earlier: a track is judged where a millimetre is left, a handle before much is. So it is
not asked how much a bend takes, but what it leaves. Play, a hand that settles and a camera's bias go on from one
stretch of the path to the next, with a bend and without. What a cam, a linkage or a curved rail leaves of a joint goes
on as well, and beside a bend nothing but noise is left, in which neighbours have nothing in common. Of a true joint
without play, noise is left before.
"""

from __future__ import annotations

import math

import numpy as np

from modcal_core.articulation.bends import CAP, VANISHES, WORTH
from modcal_core.articulation.models.axis import AxisMotion
from modcal_core.articulation.prediction_check import POSITIONS
from modcal_core.articulation.stretches import Stretches
from modcal_core.articulation.track import Track
from modcal_core.geometry.so3 import Array

_DEGREE = 4  # of the bend, a polynomial along the path
_FITTED = 2  # of the degrees that a joint's own parameters change: no bend is what these leave
_MIN = 4 * (_DEGREE + 1)  # stretches that are asked
_ASKED_EVERY = 0.02  # m of path
_ALIKE = 3.0  # deviations by which neighbours are more alike than in noise, before
_NOT_ALIKE = 1.0  # and beside the bend


class BendCheck:
    """found: whether a smooth bend is what the motion leaves, as of the last question."""

    def __init__(self, stretches: Stretches) -> None:
        """stretches: the path so far, kept by others."""
        self.found = False
        self._stretches, self._asked = stretches, 0.0

    def come(self, motion: AxisMotion | None) -> None:
        """Ask again where the path has grown. motion: the one that is selected now."""
        path = self._stretches.path
        if motion is None or path - self._asked < _ASKED_EVERY:
            return
        self._asked = path
        track = Track.trusted(self._stretches.points)
        a = motion.configurations(track, POSITIONS)
        self.found = bend_left(motion.residuals(track, a)[:, :3], a)


def bend_left(left: Array, along: Array) -> bool:
    """Whether residuals (n, 3) [m] of stretches in their order, at configurations (n,), are a smooth bend and noise."""
    near = (left * left).sum(axis=1) < CAP**2
    e, a = left[near], along[near]
    span = float(np.ptp(a)) if len(a) else 0.0
    if len(e) < _MIN or span <= 0.0:
        return False
    waves = np.polynomial.legendre.legvander(2.0 * (a - a.min()) / span - 1.0, _DEGREE)
    before, after = (_beside(waves[:, : degree + 1], e) for degree in (_FITTED, _DEGREE))
    deviation = 1.0 / math.sqrt(2.0 * len(e))  # of the likeness of noise, in two directions across the path
    if _alike(before) > _ALIKE * deviation and _alike(after) < _NOT_ALIKE * deviation:
        return True
    one, two = float((before * before).sum()), float((after * after).sum())
    return one > len(e) * WORTH**2 and two < VANISHES * one


def _beside(waves: Array, e: Array) -> Array:
    """What waves (n, k) leave of residuals (n, 3) [m]."""
    return np.asarray(e - waves @ np.linalg.lstsq(waves, e, rcond=None)[0])


def _alike(e: Array) -> float:
    """Correlation of neighbouring rows of (n, 3): 1 for equal ones, 0 for noise (von Neumann's ratio)."""
    steps, sizes = np.diff(e, axis=0), e * e
    both = float(sizes[1:].sum() + sizes[:-1].sum())
    return 1.0 - float((steps * steps).sum()) / both if both > 0.0 else 0.0

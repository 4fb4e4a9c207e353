"""Whether a path is two motions, and where it is cut: of a whole track, or asked while it comes.

A mechanism of two joints looks like one for a stretch, and predicts there. What tells it from furniture is the whole
path since the start: a cut into two lines or circles leaves nothing of what one leaves. Each side of a cut is a line or
a circle, fitted in closed form; the best cut is where both together leave least. While poses come, the path is kept as
the means of short stretches, and one cut is tried at a time.

What furniture leaves beside its ideal path (play, a bow, what distorts the camera) does not vanish by a cut: two arcs
leave about as much of it as one. What a mechanism of two joints leaves does vanish, down to the noise.
"""

from __future__ import annotations

import math

import numpy as np

from modcal_core.articulation.furniture import PLAY
from modcal_core.articulation.misfit import Stretches
from modcal_core.articulation.track import Track, backwards, one_way, travelled, white
from modcal_core.geometry import Array

MIN_PATH = 0.03  # m of a motion that is one of its own: a hand's play is less
MIN = 10  # samples of it
_TRIED = 24  # places for the cut
_PARAMETERS = 6  # of a circle in space
_WORTH = 0.5  # of the usual play: what one motion must leave beside noise for two to be considered
_VANISHES = 0.1  # of its squares may be left by two
_CAP = 0.03  # m: a sample or stretch farther off costs no more


def best_cut(track: Track) -> int | None:
    """The first row of the second motion; None where the track is too short for two."""
    if backwards(track.positions):
        cut = _best_cut(one_way(track))
        return None if cut is None else len(track) - cut
    return _best_cut(track)


def _best_cut(track: Track) -> int | None:
    way = travelled(track)
    inside = np.flatnonzero((way > MIN_PATH) & (way < way[-1] - MIN_PATH))
    inside = inside[(inside >= MIN) & (inside <= len(track) - MIN)]
    if not len(inside):
        return None
    coarse = np.unique(inside[np.linspace(0, len(inside) - 1, _TRIED).round().astype(int)])
    best = min(coarse, key=lambda k: _cost(track.positions, int(k)))
    step = max(1, len(inside) // _TRIED)
    fine = [int(k) for k in inside if abs(int(k) - int(best)) <= step]
    return min(fine[:: max(1, len(fine) // _TRIED)], key=lambda k: _cost(track.positions, k))


def two_explain(track: Track) -> str:
    """Why two motions are to be considered where one line or circle was found, as text; empty where one does."""
    cut, n = best_cut(track), len(track)
    if cut is None or 2 * n <= 4 * _PARAMETERS:
        return ""
    noise = white(track.positions) ** 2  # of positions alone: that of a fit has the rotations' in it
    one = squares(track.positions) / (2 * n - _PARAMETERS) - noise
    two = _cost(track.positions, cut) / (2 * n - 2 * _PARAMETERS) - noise
    if not vanishes(one, two):
        return ""
    at = 1e2 * where(track, cut)
    return (
        f"two motions, cut at {at:.0f} cm, leave {1e3 * np.sqrt(2.0 * max(two, 0.0)):.1f} mm beside noise where one "
        f"leaves {1e3 * np.sqrt(2.0 * one):.1f} mm"
    )


def where(track: Track, cut: int) -> float:
    """How far along the path a cut lies [m]: between the last row of the first motion and the first of the second."""
    return float(travelled(track)[cut - 1 : cut + 1].mean())


def vanishes(one: float, two: float) -> bool:
    """Whether what one motion leaves vanishes by a cut: variances on an axis, beside noise, before and after [m²]."""
    return one > (_WORTH * float(np.exp(PLAY[0]))) ** 2 / 2.0 and two <= _VANISHES * one


def _cost(p: Array, k: int) -> float:
    return squares(p[:k]) + squares(p[k:])


_MIN = 5  # stretches on either side of a cut, more than a circle's parameters have of two residuals each
_CUTS = 16  # tried along the path
_FINER = (-0.6, -0.3, 0.3, 0.6)  # of the way from cut to cut, tried beside the best
_ANEW = 0.02  # m of path after which the question is asked again


class TwoMotions:
    """found: whether the path since the start is two motions, as of the last question that was answered."""

    def __init__(self) -> None:
        self.found = False
        self._stretches = Stretches()
        self._asked = 0.0
        self._snapshot: Array | None = None
        self._noise = 0.0  # variance on an axis of a point of the snapshot [m²]
        self._left: list[int] = []  # cuts that are still to be tried
        self._tried: dict[int, float] = {}
        self._fine = False

    def come(self, p: Array, noise: float) -> None:
        """Take a position (3,) [m] that was accepted. noise: of one position, on an axis [m]."""
        self._stretches.come(p, noise)

    def advance(self, noise: float) -> None:
        """Try one cut, or ask again where the path has grown. noise: of one position, on an axis [m]."""
        if self._snapshot is not None:
            self._try(self._snapshot)
            return
        path, k = self._stretches.path, self._stretches.k
        if path - self._asked >= _ANEW and path >= 2.0 * MIN_PATH and k > 2 * _MIN:
            self._ask(noise)

    def _ask(self, noise: float) -> None:
        path, k = self._stretches.path, self._stretches.k
        self._snapshot, self._asked, self._fine = self._stretches.points, path, False
        self._noise = noise**2 * float(np.mean(1.0 / self._stretches.counts))
        ends = max(_MIN, math.ceil(MIN_PATH * k / path))
        first, last = ends, k - ends
        if last <= first:
            self._snapshot = None
            return
        self._tried = {}
        self._left = np.unique(np.linspace(first, last, _CUTS).round().astype(int)).tolist()

    def _try(self, points: Array) -> None:
        if self._left:
            cut = self._left.pop()
            self._tried[cut] = squares(points[:cut]) + squares(points[cut:])
            return
        best = min(self._tried, key=lambda cut: self._tried[cut])
        if not self._fine:
            self._fine = True
            step = (max(self._tried) - min(self._tried)) / max(len(self._tried) - 1, 1)
            near = {best + round(share * step) for share in _FINER}
            self._left = [cut for cut in near if cut not in self._tried and _MIN <= cut <= len(points) - _MIN]
            return
        n, self._snapshot = len(points), None
        one = squares(points) / (2 * n - _PARAMETERS) - self._noise
        two = self._tried[best] / (2 * n - 2 * _PARAMETERS) - self._noise
        self.found = vanishes(one, two)


def squares(p: Array) -> float:
    """Squares [m²] that the better of a line and a circle leaves of points (n, 3), capped point by point.

    The circle is the algebraic one in the plane that fits best, by normal equations about the middle.
    """
    x = p - p.mean(axis=0)
    axes = np.linalg.eigh(x.T @ x)[1]
    y = x @ axes[:, ::-1]
    flat = y[:, :2]
    size = (flat * flat).sum(axis=1)
    line = y[:, 1] ** 2 + y[:, 2] ** 2
    M = flat.T @ flat
    b = flat.T @ size
    determinant = M[0, 0] * M[1, 1] - M[0, 1] * M[1, 0]
    if determinant <= 1e-12 * M[0, 0] ** 2:
        return float(np.minimum(line, _CAP**2).sum())
    c = 0.5 * np.array([M[1, 1] * b[0] - M[0, 1] * b[1], M[0, 0] * b[1] - M[1, 0] * b[0]]) / determinant
    radius = math.sqrt(float(size.mean() + c @ c))  # as the mean of flat is zero
    apart = flat - c
    circle = (np.sqrt((apart * apart).sum(axis=1)) - radius) ** 2 + y[:, 2] ** 2
    return min(float(np.minimum(off, _CAP**2).sum()) for off in (line, circle))

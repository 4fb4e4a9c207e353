"""Whether a path is two motions, and where it is cut: of a whole track, or asked while it comes.

A mechanism of two joints looks like one for a stretch, and predicts there. Cut into two lines or circles, each fitted
in closed form, its whole path leaves nothing but noise. What furniture leaves beside its ideal path (play, a bow, what
distorts the camera) does not vanish by a cut. While poses come, the path is kept as the means of short stretches.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from modcal_core.articulation.furniture import PLAY
from modcal_core.articulation.misfit import Stretches
from modcal_core.articulation.track import Track, backwards, one_way, travelled, white
from modcal_core.geometry import Array

MIN_PATH = 0.03  # m of a motion that is one of its own: a hand's play is less
MIN = 10  # samples of it
_TRIED = 16  # places for the cut
_PARAMETERS = 6  # of a circle in space
_WORTH = 0.5  # of the usual play: what one motion must leave beside noise for two to be considered
_VANISHES = 0.1  # of its squares may be left by two
_CAP = 0.03  # m: a sample or stretch farther off costs no more


def best_cut(track: Track) -> int | None:
    """The first row of the second motion; None where the track is too short for two."""
    ordered = one_way(track)
    way = travelled(ordered)
    inside = np.flatnonzero((way > MIN_PATH) & (way < way[-1] - MIN_PATH))
    cut = _cheapest(ordered.positions, inside[(inside >= MIN) & (inside <= len(track) - MIN)])
    return len(track) - cut if cut is not None and backwards(track.positions) else cut


def _cheapest(p: Array, cuts: NDArray[np.intp]) -> int | None:
    """The one of these cuts (m,) of points (n, 3) that leaves least, as far as some and their neighbours are tried."""
    if not len(cuts):
        return None
    some = cuts[np.unique(np.linspace(0, len(cuts) - 1, _TRIED).round().astype(int))]
    best = min(some, key=lambda k: _cost(p, int(k)))
    near = cuts[np.abs(cuts - best) <= max(1, len(cuts) // _TRIED)]
    return int(min(near[:: max(1, len(near) // _TRIED)], key=lambda k: _cost(p, int(k))))


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


def are_two(stretches: Stretches, noise: float) -> bool:
    """Whether a path is two motions. noise: of one position, on an axis [m]."""
    path, k, points = stretches.path, stretches.k, stretches.points
    ends = max(_MIN, math.ceil(MIN_PATH * k / max(path, MIN_PATH)))
    cut = _cheapest(points, np.arange(ends, k - ends + 1))
    if cut is None or path < 2.0 * MIN_PATH:
        return False
    white = noise**2 * float(np.mean(1.0 / stretches.counts))
    one = squares(points) / (2 * k - _PARAMETERS) - white
    two = _cost(points, cut) / (2 * k - 2 * _PARAMETERS) - white
    return vanishes(one, two)


def squares(p: Array) -> float:
    """Squares [m²] that the better of a line and an algebraic circle leaves of points (n, 3), capped one by one."""
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

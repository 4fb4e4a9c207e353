"""Where a pull of two motions is cut: a handle that is pressed and then a door, a latch that slides and then a gate.

Each side of a cut is a line or a circle, fitted in closed form; the best cut is where both together leave least.

What furniture leaves beside its ideal path (play, a bow, what distorts the camera) does not vanish by a cut: two arcs
leave about as much of it as one. What a mechanism of two joints leaves does vanish, down to the noise.
"""

from __future__ import annotations

import numpy as np

from modcal_core.articulation.direction import backwards, one_way
from modcal_core.articulation.furniture import PLAY
from modcal_core.articulation.telling import travelled, white
from modcal_core.articulation.track import Track
from modcal_core.geometry.so3 import Array

MIN_PATH = 0.03  # m of a motion that is one of its own: a hand's play is less
MIN = 10  # samples of it
_TRIED = 24  # places for the cut
_PARAMETERS = 6  # of a circle in space
_WORTH = 0.5  # of the usual play: what one motion must leave beside noise for two to be considered
_VANISHES = 0.1  # of its squares may be left by two
_CAP = 0.03  # m: a sample farther off costs no more


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
    one = _left(track.positions) / (2 * n - _PARAMETERS) - noise
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
    return _left(p[:k]) + _left(p[k:])


def _left(p: Array) -> float:
    """Squares that the better of a line and a circle leaves [m²], capped sample by sample."""
    x = p - p.mean(axis=0)
    axes = np.linalg.svd(x, full_matrices=False)[2]
    y = x @ axes.T
    line = np.hypot(y[:, 1], y[:, 2])
    A = np.column_stack([2.0 * y[:, :2], np.ones(len(y))])
    c = np.linalg.lstsq(A, (y[:, :2] ** 2).sum(axis=1), rcond=None)[0]
    radius = np.sqrt(max(float(c[2] + c[0] ** 2 + c[1] ** 2), 1e-12))
    circle = np.hypot(np.hypot(y[:, 0] - c[0], y[:, 1] - c[1]) - radius, y[:, 2])
    return min(float((np.minimum(off, _CAP) ** 2).sum()) for off in (line, circle))

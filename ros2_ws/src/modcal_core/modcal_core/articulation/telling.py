"""Which samples tell of a track's path: no lone outliers, and of a rest only a few.

An outlier is a sample that lies where neither of its neighbours in time lies. A stretch that departs from a model is
none: it is the model that is wrong there. A handle that rests says the same again with every sample, and a hundred
of them must not outvote the motion.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from modcal_core.articulation.direction import backwards, one_way
from modcal_core.articulation.furniture import PLAY, SWAY
from modcal_core.articulation.track import Track
from modcal_core.geometry.so3 import Array

_NEAR = (-2, -1, 1, 2)  # neighbours in time; an outlier may have one or two that are outliers as well
_AROUND = 7  # samples either way, whose steps are the usual ones there
_LEAP = 4.0  # times the usual step, and the usual play of furniture
_LENGTH = 0.1  # m: a turn of 1 rad is as far as this shift
_PLACE = 3e-3  # m: samples within it, or within three deviations of noise, are in one place
_CROWD = 2.0  # times as many samples in one place as is usual on this track are enough
_FEW = 5  # samples of a place that are kept in any case
_LEAST = 6  # samples that are left; of fewer, which are outliers nobody can say
_MARK = 0.01  # m of path between marks
_Rows = NDArray[np.intp]


def telling(track: Track) -> _Rows:
    """Rows of the samples that tell of the path, in their order; all of them where too few would be left."""
    rows = np.flatnonzero(~lone(track))
    if len(rows) < _LEAST:
        return np.arange(len(track))
    moving = track.part(rows)
    kept = _without_rests(one_way(moving))
    rows = rows[np.sort(len(rows) - 1 - kept) if backwards(moving.positions) else kept]
    return rows if len(rows) >= _LEAST else np.arange(len(track))


def lone(track: Track) -> NDArray[np.bool_]:
    """Which samples (n,) are far from both their neighbours in time."""
    p, R = track.positions, track.rotations
    out = _apart(len(track), lambda i, j: np.linalg.norm(p[i] - p[j], axis=1), _LEAP * float(np.exp(PLAY[0])))
    if R is not None:
        out |= _apart(len(track), lambda i, j: _turn(R[i], R[j]), _LEAP * float(np.exp(SWAY[0])))
    return out


def _apart(n: int, distance: Callable[[_Rows, _Rows], Array], slack: float) -> NDArray[np.bool_]:
    i = np.arange(n)
    to = np.full((len(_NEAR), n), np.inf)
    for row, k in zip(to, _NEAR, strict=True):
        known = (i + k >= 0) & (i + k < n)
        row[known] = distance(i[known], i[known] + k)
    second = np.sort(to, axis=0)[1]
    steps = distance(i[:-1], i[1:])
    usual = np.array([np.median(steps[max(0, k - _AROUND) : k + _AROUND]) for k in range(n)])
    return np.asarray(second > _LEAP * usual + slack)


def _turn(R: Array, S: Array) -> Array:
    """About the angles [rad] between rotations (n, 3, 3)."""
    return np.linalg.norm((R - S).reshape(len(R), 9), axis=1) / np.sqrt(2.0)


def white(positions: Array) -> float:
    """White noise on an axis [m], from second differences, which no steady motion has."""
    bend = np.diff(positions, 2, axis=0)
    return float(np.sqrt(np.median((bend**2).sum(axis=1)) / 2.366 / 6.0)) if len(bend) else 0.0


def _without_rests(track: Track) -> _Rows:
    """Rows of a track with long stops thinned to the usual number of samples at one place."""
    p, R = track.positions, track.rotations
    reach = max(_PLACE, 3.0 * white(p))
    places, begin = [], 0
    for i in range(1, len(p)):
        away = float(np.linalg.norm(p[i] - p[begin]))
        if R is not None:
            away = max(away, _LENGTH * float(_turn(R[i : i + 1], R[begin : begin + 1])[0]))
        if away > reach:
            places.append(np.arange(begin, i))
            begin = i
    places.append(np.arange(begin, len(p)))
    most = max(_FEW, int(_CROWD * np.median([len(rows) for rows in places])))
    return np.concatenate(
        [rows[np.unique(np.linspace(0, len(rows) - 1, min(most, len(rows))).round().astype(int))] for rows in places]
    )


def travelled(track: Track) -> Array:
    """How far the handle had come along its path at each sample (n,) [m]; noise is no path."""
    p = track.positions
    if backwards(p):
        way = _way(p[::-1])
        return np.asarray(way[-1] - way[::-1])
    return _way(p)


def _way(p: Array) -> Array:
    mark = max(_MARK, 5.0 * white(p))
    at, way, out = p[0], 0.0, np.zeros(len(p))
    for i, here in enumerate(p):
        step = float(np.linalg.norm(here - at))
        if step >= mark:
            at, way = here, way + step
        out[i] = way + (0.0 if step >= mark else min(step, mark))
    return np.maximum.accumulate(out)

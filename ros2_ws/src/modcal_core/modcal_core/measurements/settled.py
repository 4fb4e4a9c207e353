"""Dwells of a whole recording; of standstills that were recorded by themselves, from when on the arm had settled.

Of such a standstill a tenth is left for settling, although whoever recorded it may have waited for that, or for too
short a time. Over all of them the readings tell: the arm has settled from where a tenth of the standstill, on average,
lies about the mean of what follows as far as the scatter lets it. What settles below that adds no more to a mean than
the readings take off.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.measurements.dwells import StationRules, inliers, settling_dwells
from modcal_core.measurements.kinds.registry import kinds
from modcal_core.measurements.recording import ReadingTrack

_TENTH, _MAX = 0.1, 0.5  # of a standstill: compared with what follows; left out at most
_FEWEST = 10  # standstills that say whether the arm had settled; as many as make a recording one of stations
_SIGMAS = 3.0  # of the mean square of so many differences, beyond which the arm is taken to settle still
_SCATTER = 3  # readings behind a tenth, from which their scatter is known


def dwells_of(t: Array, q: Array, tracks: Sequence[ReadingTrack], rules: StationRules) -> Array:
    """Start and end [s] of the times the arm stood still, (d, 2), for readings of these tracks.

    t: stamps of joint states, sorted, (m,). q: positions, (m, n).
    """
    found = settling_dwells(t, q, rules)
    alone = found[:, 0] < found[:, 1]
    begin, length = found[alone, 0], found[alone, 2] - found[alone, 0]
    if len(begin) >= _FEWEST:
        tracks = [track for track in tracks if track.kind in kinds() and len(track.stamps)]
        for share in np.arange(0.0, _MAX + 0.5 * _TENTH, _TENTH):
            bounds = np.stack([begin + share * length, begin + (share + _TENTH) * length, found[alone, 2]], axis=1)
            said = [_settled(track, bounds) for track in tracks]
            if True in said and False not in said:
                found[alone, 1] = bounds[:, 0]
                break
    return found[:, 1:]


def _settled(track: ReadingTrack, bounds: Array) -> bool | None:
    """Whether readings between the first two of bounds (d, 3) are like those behind; None where there are none."""
    order = np.argsort(track.stamps, kind="stable")
    parts = np.searchsorted(track.stamps[order], bounds).tolist()
    if all(first == start for first, start, _ in parts):
        return None
    width = min(3, track.values.shape[1])
    apart, expected, count = 0.0, 0.0, 0
    for first, start, end in parts:
        m, k = start - first, end - start
        if m == 0 or k < _SCATTER:
            continue
        values = track.values[order[first:end], :width]
        right = inliers(values)
        early, late = values[:m][right[:m]], values[m:][right[m:]]
        if len(early) == 0 or len(late) < _SCATTER:
            continue
        variance = float(np.sum((late - late.mean(axis=0)) ** 2)) / (len(late) - 1)
        apart += float(np.sum((early.mean(axis=0) - late.mean(axis=0)) ** 2))
        expected += variance * (1.0 / len(early) + 1.0 / len(late))
        count += width
    return bool(count >= _FEWEST * width and apart <= expected * (1.0 + _SIGMAS * np.sqrt(2.0 / max(count, 1))))

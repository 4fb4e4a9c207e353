"""What joints were told beside what they reported: commanded − measured at each sample.

A command holds until the next one. Commands that come close together are points of a course, and are interpolated.
Where joint states are notes of stations, a command noted right behind belongs to the same station.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import JointTrack

_COURSE = 0.1  # s between commands up to which they are points of one course; controllers are told more often
_NOTES = 0.5  # s between joint states from which they are notes of stations; drivers report many times a second
_BEHIND = 0.1  # s within which messages of one note follow each other, far below the time to the next station
_NEARER = 0.5  # times as far from what was told; a command of another station is farther by orders of magnitude
_FARTHEST = 0.2  # rad or m; a joint that is farther away does not follow this command: other units, or led by hand


def commanded_at(tracks: Sequence[JointTrack], names: Sequence[str], stamps: Array) -> Array:
    """Commanded positions (N, n) [rad, m] of the named joints at the stamps (N,) [s]; NaN where nothing was commanded.

    tracks: commands, those of a topic that is preferred first.
    """
    out = np.full((len(stamps), len(names)), np.nan)
    for j, name in enumerate(names):
        for track in tracks:
            if name in track.names:
                told = _held(track.stamps, track.position[:, track.names.index(name)], stamps)
                out[:, j] = np.where(np.isfinite(out[:, j]), out[:, j], told)
    return out


def following(tracks: Sequence[JointTrack], names: Sequence[str], t: Array, q: Array, spans: Array) -> Array:
    """Commanded − measured (N, n) [rad, m] of samples taken over spans (N, 2) [s], NaN where unknown.

    t: stamps of joint states, sorted, (m,); q: positions (m, n). It is averaged over the joint states in a span, and
    interpolated to a span of no length, which is one stamp.
    """
    out = np.full((len(spans), len(names)), np.nan)
    if not len(t) or not any(name in track.names for track in tracks for name in names):
        return out
    apart = _apart(tracks, names, t, q)
    apart[np.abs(apart) > _FARTHEST] = np.nan
    first, last = np.searchsorted(t, spans[:, 0]), np.searchsorted(t, spans[:, 1], side="right")
    long = last - first > 1
    for j, column in enumerate(apart.T):
        known = np.isfinite(column)
        total, count = (np.r_[0.0, np.cumsum(x)] for x in (np.where(known, column, 0.0), known))
        within = (count[last] - count[first])[long]
        out[long, j] = (total[last] - total[first])[long] / np.where(within > 0, within, np.nan)
        out[~long, j] = np.interp(spans[~long].mean(axis=1), t, column, left=np.nan, right=np.nan)
    return out


def _apart(tracks: Sequence[JointTrack], names: Sequence[str], t: Array, q: Array) -> Array:
    """Commanded − measured at joint states, by the command before each, or just behind where that is what was meant."""
    apart = commanded_at(tracks, names, t) - q
    if len(t) < 2 or float(np.median(np.diff(t))) < _NOTES:
        return apart
    behind = commanded_at(tracks, names, t + _BEHIND) - q
    return behind if _usually(behind) < _NEARER * _usually(apart) else apart


def _usually(apart: Array) -> float:
    known = np.abs(apart[np.isfinite(apart)])
    return float(np.median(known)) if len(known) else np.inf


def _held(t: Array, x: Array, stamps: Array) -> Array:
    """Commands x (m,) given at t (m,) as they stand at the stamps (N,); NaN before the first."""
    known = np.isfinite(x) & np.isfinite(t)
    t, x = t[known], x[known]
    if not len(t):
        return np.full(len(stamps), np.nan)
    order = np.argsort(t, kind="stable")
    t, x = t[order], x[order]
    last = np.searchsorted(t, stamps, side="right") - 1
    after = np.minimum(last + 1, len(t) - 1)
    last = np.maximum(last, 0)
    step = t[after] - t[last]
    share = np.where((step > 0.0) & (step <= _COURSE), (stamps - t[last]) / np.where(step > 0.0, step, 1.0), 0.0)
    return np.where(stamps < t[0], np.nan, x[last] + share * (x[after] - x[last]))

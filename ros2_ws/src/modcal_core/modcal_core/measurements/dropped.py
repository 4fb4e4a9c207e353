"""Readings that were recorded and never became part of a sample, counted by reason."""

from __future__ import annotations

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.measurements.dwells import StationRules, inliers
from modcal_core.measurements.kinds.registry import kinds
from modcal_core.measurements.recording import ReadingTrack, Recording, joint_stamps_and_positions
from modcal_core.measurements.samples import Samples
from modcal_core.measurements.settled import dwells_of

BETWEEN = "readings between stations"  # while the arm moved: as it should be
GLITCHES = "readings far from the others of their station"
OUTSIDE = "readings before or after the joint states"
ALONE = "readings without joint states close by, or thinned"
UNKNOWN = "readings of a kind that is not known"
UNUSABLE = "readings in stretches that cannot be used"

Dropped = tuple[tuple[str, int], ...]


def dropped(
    recording: Recording,
    samples: Samples,
    rules: StationRules | None = None,
    since: float = -np.inf,
    until: float = np.inf,
) -> Dropped:
    """How many readings stamped within [since, until) are in none of these samples, by reason.

    samples: cut from the recording.
    """
    t, q = joint_stamps_and_positions(recording, samples.names)
    order = np.argsort(t, kind="stable")
    t, q = t[order], q[order]
    count = dict.fromkeys((BETWEEN, GLITCHES, OUTSIDE, ALONE, UNKNOWN), 0)
    dwells: Array | None = None
    for track in recording.readings:
        stamps = track.stamps[(track.stamps >= since) & (track.stamps < until)]
        if track.kind not in kinds():
            count[UNKNOWN] += len(stamps)
            continue
        inside = stamps[(stamps >= t[0]) & (stamps <= t[-1])] if len(t) else stamps[:0]
        count[OUTSIDE] += len(stamps) - len(inside)
        rows = _rows_of(track, samples, since, until)
        if samples.moving[rows].any() or np.isin(samples.stamps[rows], track.stamps).all():
            count[ALONE] += max(len(inside) - len(rows), 0)
        else:
            dwells = dwells_of(t, q, recording.readings, rules or StationRules()) if dwells is None else dwells
            within, wrong = _in_dwells(track, inside, dwells)
            count[BETWEEN] += len(inside) - within
            count[GLITCHES] += wrong
    return tuple((reason, n) for reason, n in count.items() if n)


def together(parts: list[Dropped]) -> Dropped:
    """The sums over parts of a recording."""
    total: dict[str, int] = {}
    for reason, n in (pair for part in parts for pair in part):
        total[reason] = total.get(reason, 0) + n
    return tuple(total.items())


def unexpected(counts: Dropped) -> int:
    """How many readings were dropped though the arm stood still, or for a reason that its motion does not explain."""
    return sum(n for reason, n in counts if reason != BETWEEN and reason.startswith("readings"))


def _rows_of(track: ReadingTrack, samples: Samples, since: float, until: float) -> np.ndarray:
    """Rows of the samples that came of a track."""
    if track.frame not in samples.frames:
        return np.empty(0, int)
    mine = (samples.frame == samples.frames.index(track.frame)) & (samples.kind == track.kind)
    return np.flatnonzero(mine & (samples.stamps >= since) & (samples.stamps < until))


def _in_dwells(track: ReadingTrack, stamps: Array, dwells: Array) -> tuple[int, int]:
    """Number of stamps of a track in dwells (d, 2), and number of those readings that are in no mean."""
    order = np.argsort(track.stamps, kind="stable")
    ordered, values, own = track.stamps[order], track.values[order, :3], np.sort(stamps)
    within, wrong = 0, 0
    for (first, last), rows in zip(np.searchsorted(own, dwells), np.searchsorted(ordered, dwells), strict=True):
        if last > first:
            within += int(last - first)
            wrong += int((~inliers(values[slice(*rows)])).sum())
    return within, wrong

"""Readings of a tracker that hangs: the same pose to the last bit, with new stamps, while the joints go on.

A mean over a station, or a few stations in a row, would take them for measurements of postures that nobody measured.
Alone a run of equal readings says little: a coarse instrument repeats itself at rest, a bridge that publishes faster
than its tracker does so in motion. It must last, and the arm must have been elsewhere meanwhile.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.measurements.dropouts import MAX_GLITCHES
from modcal_core.measurements.recording import POSE, ReadingTrack, Recording, joint_stamps_and_positions
from modcal_core.measurements.returns import LEFT

HUNG = "readings repeated while the joints moved"
_MIN = 5  # equal readings in a row
_LASTS = 1.0  # s; trackers that are read slower than once a second are read at stations
_MAX = 0.5  # share of all; beyond, the topic is none of the target, and is refused as such


@dataclass(frozen=True)
class Hung:
    """Which readings of each track those are, a sentence a topic, and those of them that make a verdict open."""

    rows: tuple[np.ndarray, ...]
    notes: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()

    @property
    def dropped(self) -> tuple[tuple[str, int], ...]:
        """How many they are, by reason."""
        count = sum(int(rows.sum()) for rows in self.rows)
        return ((HUNG, count),) if count else ()

    def left_out(self, recording: Recording) -> Recording:
        """The recording, or one of as many readings, without them."""
        if not self.dropped:
            return recording
        readings = tuple(track.rows(~rows) for track, rows in zip(recording.readings, self.rows, strict=True))
        return replace(recording, readings=readings)


def hung(recording: Recording, names: tuple[str, ...]) -> Hung:
    """What a tracker repeated while it hung. Of each run the first reading is none of them.

    Stamps have to be on the joints' clock already.
    """
    t, q = joint_stamps_and_positions(recording, names)
    order = np.argsort(t, kind="stable")
    found, notes, doubts = [], [], []
    for track in recording.readings:
        rows = _repeated(track, t[order], q[order])
        count = int(rows.sum())
        if count > _MAX * len(rows):
            rows[:], count = False, 0
        found.append(rows)
        if not count:
            continue
        first = float(track.stamps[int(np.argmax(rows))])
        said = (
            f"{track.topic} ({track.frame}): the same pose to the last digit while the joints moved, in {count} of "
            f"{len(rows)} readings, first at {first:.3f} s: the tracker hung, or had lost its target"
        )
        notes.append(f"{said}. They were left out.")
        if count > MAX_GLITCHES * len(rows):
            doubts.append(f"{said}, and too often for single wrong readings. See its driver and its sight.")
    return Hung(tuple(found), tuple(notes), tuple(doubts))


def _repeated(track: ReadingTrack, t: Array, q: Array) -> np.ndarray:
    """Which readings are those, (m,). t, q: joint states in order of time, (k,), (k, n)."""
    out = np.zeros(len(track.stamps), dtype=np.bool_)
    if track.kind != POSE or len(t) < 2 or len(out) < _MIN:
        return out
    order = np.argsort(track.stamps, kind="stable")
    stamps, values = track.stamps[order], track.values[order]
    edges = np.flatnonzero(np.r_[True, (np.diff(values, axis=0) != 0.0).any(axis=1), True])
    for start, end in pairwise(edges.tolist()):
        if end - start < _MIN or stamps[end - 1] - stamps[start] < _LASTS:
            continue
        low, high = np.searchsorted(t, (stamps[start], stamps[end - 1]))
        went = q[low : high + 1]
        if len(went) and np.ptp(went, axis=0).max() > LEFT:
            out[order[start + 1 : end]] = True
    return out

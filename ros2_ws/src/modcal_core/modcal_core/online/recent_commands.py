"""Recent commands to an arm, to compare with reported positions, in bounded memory."""

from __future__ import annotations

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.measurements.commanded import following
from modcal_core.measurements.recording import JointTrack

_HELD = 4096  # commands; 4 s at 1 kHz, and any stand at the usual rates


class RecentCommands:
    """The last commands for these joints. Stamps in seconds, positions in rad and m."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self._names = names
        self._t = np.empty(2 * _HELD)
        self._q = np.empty((2 * _HELD, len(names)))
        self._first = self._end = 0

    def add(self, stamps: Array, positions: Array) -> None:
        """Take commands (k, n), NaN for joints that they do not name, at rising stamps (k,); later ones are replaced.

        So a trajectory takes the place of what is left of the one before.
        """
        stamps, positions = stamps[-_HELD:], positions[-_HELD:]
        if not len(stamps):
            return
        self._end = self._first + int(np.searchsorted(self._t[self._first : self._end], stamps[0]))
        if self._end + len(stamps) > len(self._t):
            keep = slice(max(self._end - _HELD, self._first), self._end)
            kept = keep.stop - keep.start
            self._t[:kept], self._q[:kept] = self._t[keep].copy(), self._q[keep].copy()
            self._first, self._end = 0, kept
        if self._end > self._first:  # what a message does not name stays as it was told
            positions = np.where(np.isfinite(positions), positions, self._q[self._end - 1])
        rows = slice(self._end, self._end + len(stamps))
        self._t[rows], self._q[rows] = stamps, positions
        self._end = rows.stop
        self._first = max(self._first, self._end - _HELD)

    def following(self, t: Array, q: Array, span: tuple[float, float]) -> Array:
        """Commanded − measured (n,) over a span [s]; NaN where unknown. t (m,), q (m, n): joint states about it."""
        told = self._t[self._first : self._end]
        about = slice(max(int(np.searchsorted(t, span[0])) - 1, 0), int(np.searchsorted(t, span[1], side="right")) + 1)
        t, q = t[about], q[about]
        if not len(told) or not len(t) or t[-1] < told[0]:
            return np.full(len(self._names), np.nan)
        since = max(int(np.searchsorted(told, t[0], side="right")) - 1, 0)
        until = int(np.searchsorted(told, t[-1], side="right")) + 1
        rows = slice(self._first + since, min(self._first + until, self._end))
        unknown = np.full((rows.stop - rows.start, len(self._names)), np.nan)
        track = JointTrack(self._names, self._t[rows], self._q[rows], unknown, unknown, unknown[:, 0])
        return following((track,), self._names, t, q, np.array([span]))[0]

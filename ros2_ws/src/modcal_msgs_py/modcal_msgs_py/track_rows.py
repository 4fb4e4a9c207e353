"""Columns of one track that grow message by message, and the track that they become."""

from __future__ import annotations

from array import array
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import JointTrack, ReadingTrack, SignalTrack

_MAX_GROWTH = 16  # times the rows that there are, where more are expected: an index that lies fills no memory


class TrackRows:
    """Growing columns of one track, eight bytes a number, however long a node listens.

    What was handed out of them stays as it is: later rows are written behind it, or to a larger copy.
    """

    def __init__(self, width: int, expected: int = 0) -> None:
        """Rows of ``width`` numbers. expected: how many rows there may be, where that is known; it may be wrong."""
        self.width = width
        self._expected = expected
        self._waiting = array("d"), array("d"), array("d")  # stamps, received and values that came one by one
        self._forget()

    def __len__(self) -> int:
        """How many rows there are."""
        return self._count + len(self._waiting[0])

    def append(self, stamp: float, received: float, values: Any) -> None:
        """Add one row of ``width`` numbers."""
        stamps, times, numbers = self._waiting
        stamps.append(stamp)
        times.append(received)
        if isinstance(values, array):
            numbers.extend(values)
        else:
            numbers.frombytes(np.asarray(values, dtype=float).tobytes())

    def extend(self, stamps: Array, received: Array, *values: NDArray[Any]) -> None:
        """Add many rows: stamps and received (n,), and numbers side by side, (n, k) each and ``width`` together."""
        self._settle()
        self._write(stamps, received, values)

    def forget_before(self, received: float) -> None:
        """Forget all rows but those since the first that was received at this time or later."""
        stamps, times, values = self.columns()
        late = np.flatnonzero(times >= received)
        first = int(late[0]) if len(late) else len(times)
        self._forget()
        self._write(stamps[first:], times[first:], (values[first:],))

    def columns(self) -> tuple[Array, Array, Array]:
        """(stamps (N,), received (N,), values (N, width)) of the rows so far."""
        self._settle()
        return self._stamps[: self._count], self._received[: self._count], self._values[: self._count]

    def _forget(self) -> None:
        self._count = 0
        self._stamps, self._received, self._values = np.empty(0), np.empty(0), np.empty((0, self.width))

    def _settle(self) -> None:
        """Write the rows that came one by one behind the others."""
        n = len(self._waiting[0])
        if n:
            stamps, received, values = (np.frombuffer(numbers) if numbers else np.empty(0) for numbers in self._waiting)
            self._waiting = array("d"), array("d"), array("d")
            self._write(stamps, received, (values.reshape(n, self.width),))

    def _write(self, stamps: Array, received: Array, values: tuple[NDArray[Any], ...]) -> None:
        begin, end = self._count, self._count + len(stamps)
        if end > len(self._stamps):
            room = max(2 * end, min(self._expected, _MAX_GROWTH * end))
            self._stamps = _with_room(self._stamps[:begin], room)
            self._received = _with_room(self._received[:begin], room)
            self._values = _with_room(self._values[:begin], room)
        self._stamps[begin:end] = stamps
        self._received[begin:end] = received
        left = 0
        for numbers in values:
            right = left + numbers.shape[1]
            self._values[begin:end, left:right] = numbers
            left = right
        assert left == self.width
        self._count = end


def _with_room(rows: Array, room: int) -> Array:
    """A copy of the rows with room for so many in all; what is not written yet takes no memory."""
    out = np.empty((room, *rows.shape[1:]))
    out[: len(rows)] = rows
    return out


def joint_track(topic: str, names: tuple[str, ...], rows: TrackRows) -> JointTrack:
    """Joint states of one publisher: position, velocity and effort beside each other in a row."""
    stamps, received, values = rows.columns()
    position, velocity, effort = np.split(values, 3, axis=1)
    return JointTrack(names, stamps, position, velocity, effort, received, topic)


def reading_track(kind: str, frame: str, rows: TrackRows, topic: str, by_type: bool) -> ReadingTrack:
    """Readings of one instrument: the last two numbers of a row are what it states of its own error."""
    stamps, received, columns = rows.columns()
    values, stated = columns[:, :-2], columns[:, -2:]
    return ReadingTrack(
        kind, frame, stamps, values, received, topic, stated if np.isfinite(stated).any() else None, by_type
    )


def signal_track(name: str, rows: TrackRows, topic: str) -> SignalTrack:
    """One signal."""
    stamps, _, values = rows.columns()
    return SignalTrack(name, stamps, values, topic)

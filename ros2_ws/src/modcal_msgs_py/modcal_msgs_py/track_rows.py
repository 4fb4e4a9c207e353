"""Columns of one track that grow message by message, and the track that they become."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import JointTrack, ReadingTrack, SignalTrack


@dataclass
class TrackRows:
    """Growing columns of one track, eight bytes a number, however long a node listens."""

    width: int
    stamps: array[float] = field(default_factory=lambda: array("d"))
    received: array[float] = field(default_factory=lambda: array("d"))
    values: array[float] = field(default_factory=lambda: array("d"))

    def append(self, stamp: float, received: float, values: Any) -> None:
        """Add one row of ``width`` numbers."""
        self.stamps.append(stamp)
        self.received.append(received)
        if isinstance(values, array):
            self.values.extend(values)
        else:
            self.values.frombytes(np.asarray(values, dtype=float).tobytes())

    def extend(self, stamps: Array, received: Array, values: Array) -> None:
        """Add many rows: stamps and received (n,), values (n, width)."""
        for column, new in ((self.stamps, stamps), (self.received, received), (self.values, values)):
            column.frombytes(np.ascontiguousarray(new, dtype=float).tobytes())

    def forget_before(self, received: float) -> None:
        """Forget all rows but those since the first that was received at this time or later."""
        late = np.flatnonzero(np.array(self.received) >= received)
        first = int(late[0]) if len(late) else len(self.received)
        self.stamps, self.received = self.stamps[first:], self.received[first:]
        self.values = self.values[first * self.width :]

    def columns(self) -> tuple[Array, Array, Array]:
        """(stamps (N,), received (N,), values (N, width)), copied."""
        return (
            np.array(self.stamps),
            np.array(self.received),
            np.array(self.values).reshape(len(self.stamps), self.width),
        )


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

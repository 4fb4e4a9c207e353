"""Samples: what a fit sees. One row is one reading of one instrument at one posture of the arm."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import POINT, POSE, SignalTrack

SHARED = ("names", "frames", "signals", "sockets", "clock")  # fields of Samples that have no row for each sample
KIND_NAMES = np.dtype("U32")  # of Samples.kind; a kind with a longer name is refused


@dataclass(frozen=True)
class Samples:
    """N readings with the postures they belong to, all arrays with N rows.

    q: joint positions [rad, m], (N, n), columns in the order of ``names``.
    stamps: [s], (N,). station: number of the dwell or moment; readings of one station share it, and splits keep them
    together. frame: index into ``frames``. kind: "pose", "point" or another (see measurements/kinds).
    position: reading in its frame [m], (N, 3); of other kinds their one to three numbers, zeros behind them.
    R: orientation reading, (N, 3, 3), identity where there is none.
    sigma_position [m, or the kind's unit], sigma_rotation [rad]: standard deviation of the reading per axis, (N,), NaN
    where unknown.
    velocity: of the joints [rad/s, m/s], (N, n), zero in a dwell, NaN where unknown. moving: taken in motion.

    What led up to a sample and went on beside it, where it is known: acceleration: of the joints, (N, n), zero where
    unknown. approach: the direction each joint last moved in, −1, 0 (unknown) or 1, (N, n). effort: torque or force of
    the actuators [N m, N], (N, n), NaN where not sent. signals: whole tracks of everything else that was recorded.

    sockets: frames that are stated to show one fixed point. clock: whether stamps are times rather than an order.
    """

    names: tuple[str, ...]
    frames: tuple[str, ...]
    q: Array
    stamps: Array
    station: np.ndarray
    frame: np.ndarray
    kind: np.ndarray
    position: Array
    R: Array
    sigma_position: Array
    sigma_rotation: Array
    velocity: Array
    moving: np.ndarray
    acceleration: Array = field(default_factory=lambda: np.empty((0, 0)))
    approach: Array = field(default_factory=lambda: np.empty((0, 0)))
    effort: Array = field(default_factory=lambda: np.empty((0, 0)))
    signals: tuple[SignalTrack, ...] = ()
    sockets: tuple[str, ...] = ()
    clock: bool = True

    def __post_init__(self) -> None:
        """What is not given is unknown."""
        for name, unknown in (("acceleration", 0.0), ("approach", 0.0), ("effort", np.nan)):
            if getattr(self, name).shape != self.q.shape:
                object.__setattr__(self, name, np.full(self.q.shape, unknown))

    def __len__(self) -> int:
        return len(self.q)

    @cached_property
    def is_pose(self) -> np.ndarray:
        """True where the reading has an orientation, (N,)."""
        return np.full(len(self), self.kinds[0] == POSE) if len(self.kinds) == 1 else self.kind == POSE

    @cached_property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of reading there are."""
        alike = len(self.kind) > 0 and bool((self.kind == self.kind[0]).all())  # far quicker than to sort them
        return (str(self.kind[0]),) if alike else tuple(np.unique(self.kind).tolist())

    @cached_property
    def stations(self) -> int:
        """Number of distinct stations."""
        return len(np.unique(self.station))

    def select(self, rows: np.ndarray | slice) -> Samples:
        """The samples at the given rows (mask, indices or slice), in that order."""
        arrays = {f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name not in SHARED}
        return replace(self, **arrays)

    def between(self, since: float, until: float) -> Samples:
        """The samples with since <= stamp < until [s], and the signals of that time."""
        if since == -np.inf and until == np.inf:
            return self
        signals = []
        for track in self.signals:
            rows = (track.stamps >= since) & (track.stamps < until)
            signals.append(replace(track, stamps=track.stamps[rows], values=track.values[rows]))
        own = self.select((self.stamps >= since) & (self.stamps < until))
        return replace(own, signals=tuple(signals))

    def join(self, other: Samples) -> Samples:
        """These samples and others of the same recording, in the order of their stamps; stations keep their numbers."""
        arrays: dict[str, Any] = {
            f.name: np.concatenate([getattr(self, f.name), getattr(other, f.name)])
            for f in fields(self)
            if f.name not in SHARED
        }
        return replace(self, **arrays).select(np.argsort(np.r_[self.stamps, other.stamps], kind="stable"))

    def followed_by(self, other: Samples) -> Samples:
        """These samples and those of another recording of the same cell, whose stations are numbered on."""
        frames = tuple(dict.fromkeys((*self.frames, *other.frames)))
        index = np.array([frames.index(name) for name in other.frames])
        tracks = {track.name: track for track in self.signals}
        for track in other.signals:
            before = tracks.get(track.name)
            if before is not None:
                stamps = np.r_[before.stamps, track.stamps]
                track = replace(track, stamps=stamps, values=np.concatenate([before.values, track.values]))
            tracks[track.name] = track
        station = other.station + self.station.max(initial=-1) + 1
        signals = tuple(tracks.values())
        numbered = replace(other, frames=frames, frame=index[other.frame], station=station, signals=signals)
        sockets = tuple(dict.fromkeys((*self.sockets, *other.sockets)))
        clock = self.clock and other.clock
        return replace(self, frames=frames, signals=signals, sockets=sockets, clock=clock).join(numbered)

    def is_same_point(self, frame: int) -> bool:
        """Whether this frame is stated to show one fixed point, as of a ball held in a socket."""
        return self.frames[frame] in self.sockets

    def stands_still(self, frame: int) -> bool:
        """Whether every reading in this frame is one and the same point."""
        rows = self.frame == frame
        if (self.kind[rows] != POINT).any() or rows.sum() < 2:
            return False
        return bool(np.ptp(self.position[rows], axis=0).max() == 0.0)

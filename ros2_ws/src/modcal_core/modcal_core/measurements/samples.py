"""Samples: what a fit sees. One row is one reading of one instrument at one posture of the arm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadRecording
from modcal_core.geometry.read_only import view
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.arrays import commands_of, joints_of, readings_of, sigma_of, signals_of
from modcal_core.measurements.origin import Origin
from modcal_core.measurements.pairing import paired_columns
from modcal_core.measurements.recording import ORDER_ONLY, POINT, POSE, Recording, SignalTrack

SHARED = (
    "names",
    "frames",
    "signals",
    "sockets",
    "clock",
    "origin",
)  # fields of Samples that have no row for each sample


@dataclass(frozen=True)
class Samples:
    """N readings with the postures they belong to, all arrays with N rows and read-only.

    q: joint positions [rad, m], (N, n), columns in the order of ``names``.
    stamps: [s], (N,). station: number of the dwell or moment; readings of one station share it, and splits keep them
    together. frame: index into ``frames``. kind: "pose", "point" or another (see measurements/kinds).
    reading: in its frame [m], (N, 3); of other kinds their one to three numbers, zeros behind them.
    R: orientation reading, (N, 3, 3), identity where there is none.
    sigma_position [m, or the kind's unit], sigma_rotation [rad]: standard deviation of the reading per axis, (N,), NaN
    where unknown.
    velocity: of the joints [rad/s, m/s], (N, n), zero in a dwell, NaN where unknown. moving: taken in motion.

    What led up to a sample and went on beside it, where it is known: acceleration: of the joints, (N, n), zero where
    unknown. approach: the direction each joint last moved in, −1, 0 (unknown) or 1, (N, n). effort: torque or force of
    the actuators [N m, N], (N, n), NaN where not sent. following: commanded − measured position [rad, m], (N, n), NaN
    where no command is known. signals: whole tracks of everything else that was recorded.

    sockets: frames that are stated to show one fixed point. clock: whether stamps are times rather than an order.
    origin: the recording they are from. names: empty where columns are in the robot's order.
    """

    names: tuple[str, ...]
    frames: tuple[str, ...]
    q: Array
    stamps: Array
    station: np.ndarray
    frame: np.ndarray
    kind: np.ndarray
    reading: Array
    R: Array
    sigma_position: Array
    sigma_rotation: Array
    velocity: Array
    moving: np.ndarray
    acceleration: Array = field(default_factory=lambda: np.empty((0, 0)))
    approach: Array = field(default_factory=lambda: np.empty((0, 0)))
    effort: Array = field(default_factory=lambda: np.empty((0, 0)))
    following: Array = field(default_factory=lambda: np.empty((0, 0)))
    signals: tuple[SignalTrack, ...] = ()
    sockets: tuple[str, ...] = ()
    clock: bool = True
    origin: Origin = field(default_factory=Origin)

    def __post_init__(self) -> None:
        """Fill missing fields with unknown values, and make all arrays read-only."""
        for name, unknown in (("acceleration", 0.0), ("approach", 0.0), ("effort", np.nan), ("following", np.nan)):
            if getattr(self, name).shape != self.q.shape:
                object.__setattr__(self, name, np.full(self.q.shape, unknown))
        for name in _ARRAYS:
            object.__setattr__(self, name, view(getattr(self, name)))

    @classmethod
    def from_arrays(
        cls,
        q: ArrayLike,
        points: ArrayLike | None = None,
        poses: ArrayLike | None = None,
        ranges: Mapping[str, ArrayLike] | None = None,
        *,
        names: Sequence[str] | None = None,
        stamps: ArrayLike | None = None,
        sigma: ArrayLike | None = None,
        sigma_rad: ArrayLike | None = None,
        temperatures: Mapping[str, ArrayLike] | None = None,
        signals: Mapping[str, ArrayLike] | None = None,
        efforts: ArrayLike | None = None,
        commanded: ArrayLike | None = None,
        frame: str = "tracker",
    ) -> Samples:
        """Samples of N postures from arrays, which are copied.

        q: joint positions [rad, m], (N, n). One of points: what the instrument sees, (N, 3) [m]; poses: (N, 4, 4) or
        x y z qx qy qz qw (N, 7) [m]; ranges: distances (N,) [m] to fixed anchors, by the anchor's name. Readings that
        are NaN are left out. names: of the joints, by column; None: in the robot's order. stamps: [s], (N,),
        increasing; None: rows are stations in the order in which they were measured. Rows close in time are taken for
        a log of a moving arm, and averaged where it stood still. sigma, sigma_rad: standard deviation of a reading per
        axis [m], [rad], one for all or one a row. temperatures [°C], signals: (N,) each, by name; an error may depend
        on them. efforts: torque or force of the actuators [N m, N], (N, n). commanded: where the joints were told to be
        [rad, m], (N, n). frame: the name of the instrument's frame.

        Raises BadRecording for arrays that do not fit together, with the row, and NotEnoughData for empty ones.
        """
        track = joints_of(q, names, stamps, efforts)
        t = track.stamps
        readings = readings_of(points, poses, ranges, t, frame)
        recording = Recording(
            joints=(track,),
            readings=tuple(readings),
            signals=(*signals_of("temperature", temperatures, t), *signals_of("signal", signals, t)),
            source="arrays",
            warnings=(ORDER_ONLY,) if stamps is None else (),
            commands=commands_of(commanded, track),
        )
        samples = cls(**paired_columns(recording, track.names))
        instrument = "; ".join(dict.fromkeys(f"{reading.kind} in {reading.frame}" for reading in readings))
        return replace(
            samples,
            names=() if names is None else track.names,
            sigma_position=sigma_of("sigma", sigma, samples.stamps, t, samples.sigma_position),
            sigma_rotation=sigma_of("sigma_rad", sigma_rad, samples.stamps, t, samples.sigma_rotation),
            origin=Origin(
                "arrays", began=None if stamps is None else float(t[0]), instrument=instrument, checked=False
            ),
        )

    def of_joints(self, names: tuple[str, ...]) -> Samples:
        """The samples with the columns of these joints, in this order.

        Raises BadRecording where one of them is missing, or where columns without names are more or fewer.
        """
        if self.names == names:
            return self
        if not self.names:
            if self.q.shape[1] != len(names):
                said = f"has {self.q.shape[1]} columns, the robot {len(names)} joints"
                raise BadRecording("q", said, f"give one column for each of {', '.join(names)}")
            return replace(self, names=names)
        missing = [name for name in names if name not in self.names]
        if missing:
            said = f"is not one of the samples' joints ({', '.join(self.names)})"
            raise BadRecording(f"joint {missing[0]}", said, "name the columns of q as the robot does")
        columns = [self.names.index(name) for name in names]
        wide = {name: getattr(self, name)[:, columns] for name in _BY_JOINT}
        return replace(self, names=names, **wide)

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
        return bool(np.ptp(self.reading[rows], axis=0).max() == 0.0)


_BY_JOINT = ("q", "velocity", "acceleration", "approach", "effort", "following")
_ARRAYS = tuple(f.name for f in fields(Samples) if f.name not in SHARED)

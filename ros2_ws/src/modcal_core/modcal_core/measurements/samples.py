"""Samples: what a fit sees. One row is one reading of one instrument at one posture of the arm.

A posture and what was read there, to a microradian and a micrometre, do not come again: who finds them in two
recordings looks at the same measurement twice. A few marks of a recording are enough to tell how much of another one it
holds: those with the least numbers, which are a random choice of them (Broder 1997).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadRecording
from modcal_core.geometry import Array, se3, so3, view
from modcal_core.measurements.dwells import StationRules, spread_rows
from modcal_core.measurements.kinds.kind import KIND_NAMES
from modcal_core.measurements.kinds.registry import kinds
from modcal_core.measurements.pairing import paired_columns
from modcal_core.measurements.path import UNKNOWN
from modcal_core.measurements.recording import (
    ORDER_ONLY,
    POINT,
    POSE,
    JointTrack,
    ReadingTrack,
    Recording,
    SignalTrack,
    commands_of,
    joints_of,
    readings_of,
    sigma_of,
    signals_of,
)

# --- Where samples come from: what a report is traced back to, and what was noticed on the way to them


@dataclass(frozen=True)
class Origin:
    """The origin of samples; all of it unknown where nothing is stated.

    title: name of the recording. notes: a sentence each, as text. dropped: readings that are in no sample, by
    reason. doubts: sentences on what was left out too often, which make a verdict open. began: first stamp of the
    recording [s]. sha256: of the bag. instrument: kind of reading, topic and frame. description: the recorded URDF.
    by_type: topics of readings that nobody named. instrument_mm, instrument_deg: what instruments state of their own
    error, where the data bear it out. checked: whether units and joints were compared with a robot. undelayed: whether
    readings in motion are on the joints' clock.
    """

    title: str = "recording"
    notes: tuple[str, ...] = ()
    dropped: tuple[tuple[str, int], ...] = ()
    began: float | None = None
    sha256: str | None = None
    instrument: str | None = None
    description: str | None = field(default=None, repr=False)
    by_type: tuple[str, ...] = ()
    instrument_mm: float | None = None
    instrument_deg: float | None = None
    checked: bool = True
    doubts: tuple[str, ...] = ()
    undelayed: bool = False


SHARED = ("names", "frames", "signals", "sockets", "clock", "origin")  # fields of Samples without a row for each


_BY_ROW: dict[str, Callable[[int], np.ndarray]] = {  # what is not given, of so many rows
    "stamps": lambda N: np.arange(float(N)),
    "station": np.arange,
    "frame": lambda N: np.zeros(N, int),
    "kind": lambda N: np.full(N, POSE, dtype=KIND_NAMES),
    "R": lambda N: np.tile(np.eye(3), (N, 1, 1)),
    **dict.fromkeys(("sigma_position", "sigma_rotation"), lambda N: np.full(N, np.nan)),
    "moving": lambda N: np.zeros(N, bool),
}
_not_given = partial(np.empty, 0)  # filled in at once, below


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

    What led up to a sample and went on beside it, where it is known: acceleration, mean_acceleration: of the joints
    there and over some hundredths of a second, with mean_jerk, (N, n), zero where unknown. approach: the direction each
    joint last moved in, −1, 0 (unknown) or 1, (N, n). path: how far each joint is ahead of followers with play at least
    and at most (measurements/path), (N, n, 2, widths). effort: torque or force of the actuators [N m, N], (N, n), NaN
    where not sent. following: commanded − measured position [rad, m], (N, n), NaN where no command is known. signals:
    whole tracks of everything else that was recorded.

    sockets: frames that are stated to show one fixed point. clock: whether stamps are times rather than an order.
    origin: the recording they are from. names: empty where columns are in the robot's order. What is not given is what
    a pose at rest in the first frame has, each at a station of its own, whose deviations nobody knows.
    """

    names: tuple[str, ...]
    frames: tuple[str, ...]
    q: Array
    reading: Array
    stamps: Array = field(default_factory=_not_given)
    station: np.ndarray = field(default_factory=_not_given)
    frame: np.ndarray = field(default_factory=_not_given)
    kind: np.ndarray = field(default_factory=_not_given)
    R: Array = field(default_factory=_not_given)
    sigma_position: Array = field(default_factory=_not_given)
    sigma_rotation: Array = field(default_factory=_not_given)
    velocity: Array = field(default_factory=_not_given)
    moving: np.ndarray = field(default_factory=_not_given)
    acceleration: Array = field(default_factory=_not_given)
    mean_acceleration: Array = field(default_factory=_not_given)
    mean_jerk: Array = field(default_factory=_not_given)
    approach: Array = field(default_factory=_not_given)
    path: Array = field(default_factory=lambda: np.empty((0, 0, 0, 0)))
    effort: Array = field(default_factory=_not_given)
    following: Array = field(default_factory=_not_given)
    signals: tuple[SignalTrack, ...] = ()
    sockets: tuple[str, ...] = ()
    clock: bool = True
    origin: Origin = field(default_factory=Origin)

    def __post_init__(self) -> None:
        """Fill missing fields with unknown values, and make all arrays read-only."""
        for name, made in _BY_ROW.items():
            if not len(getattr(self, name)):
                object.__setattr__(self, name, made(len(self.q)))
        zero, nan = ("velocity", "acceleration", "mean_acceleration", "mean_jerk", "approach"), ("effort", "following")
        for name, unknown in (*((name, 0.0) for name in zero), *((name, np.nan) for name in nan)):
            if getattr(self, name).shape != self.q.shape:
                object.__setattr__(self, name, np.full(self.q.shape, unknown))
        if self.path.shape[:2] != self.q.shape:
            object.__setattr__(self, "path", np.broadcast_to(UNKNOWN, (*self.q.shape, *UNKNOWN.shape)))
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

    @classmethod
    def from_frame(cls, table: Any, joints: Sequence[str], readings: Sequence[str], **more: Any) -> Samples:
        """Samples of the rows of a pandas DataFrame. joints: its columns of joint positions [rad, m], by their names.
        readings: columns x y z [m], or x y z qx qy qz qw. more: as of :meth:`from_arrays`, stamps and sigma also by the
        name of a column. Raises BadRecording.
        """
        by_name = {key: [name] for key, name in more.items() if isinstance(name, str) and key != "frame"}
        try:
            q, values = (table[list(names)].to_numpy(float) for names in (joints, readings))
            more |= {key: table[name].to_numpy(float)[:, 0] for key, name in by_name.items()}
        except KeyError as error:
            there = ", ".join(map(str, table.columns))
            raise BadRecording(f"column {error}", "is not in the frame", f"choose among {there}") from error
        more["points" if values.shape[1] == 3 else "poses"] = values
        return cls.from_arrays(q, names=tuple(joints), **more)

    def to_frame(self) -> Any:
        """As a pandas DataFrame: joints by name, stamp, station, frame, kind, x y z and, of poses, qx qy qz qw."""
        names = self.names or tuple(f"q{k}" for k in range(self.q.shape[1]))
        turns = np.where((self.kind == POSE)[:, None], so3.to_quaternion(self.R), np.nan)
        columns = {**dict(zip(names, self.q.T, strict=True)), "stamp": self.stamps, "station": self.station}
        columns |= {"frame": np.array(self.frames)[self.frame], "kind": self.kind.astype(str)}
        columns |= dict(zip(("x", "y", "z", "qx", "qy", "qz", "qw"), np.c_[self.reading, turns].T, strict=True))
        return import_module("pandas").DataFrame(columns)

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
        signals = tuple(track.rows((track.stamps >= since) & (track.stamps < until)) for track in self.signals)
        return replace(self.select((self.stamps >= since) & (self.stamps < until)), signals=signals)

    def join(self, *others: Samples) -> Samples:
        """These samples and others of the same recording, in the order of their stamps; stations keep their numbers."""
        parts, names = (self, *others), [f.name for f in fields(self) if f.name not in SHARED]
        arrays: dict[str, Any] = {name: np.concatenate([getattr(s, name) for s in parts]) for name in names}
        return replace(self, **arrays).select(np.argsort(arrays["stamps"], kind="stable"))

    def followed_by(self, other: Samples) -> Samples:
        """These samples and those of another recording of the same cell, whose stations are numbered on."""
        frames = tuple(dict.fromkeys((*self.frames, *other.frames)))
        index = np.array([frames.index(name) for name in other.frames])
        tracks = {track.name: track for track in self.signals}
        for track in other.signals:
            tracks[track.name] = tracks[track.name].followed_by(track) if track.name in tracks else track
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


_BY_JOINT = (
    "q",
    "velocity",
    "acceleration",
    "mean_acceleration",
    "mean_jerk",
    "approach",
    "path",
    "effort",
    "following",
)
_ARRAYS = tuple(f.name for f in fields(Samples) if f.name not in SHARED)


# --- Samples of a recording, and the recording that samples would be


def cut_stations(recording: Recording, names: tuple[str, ...], rules: StationRules | None = None) -> Samples:
    """The samples of a recording, for these joints in this order; stations keep their number over all instruments.

    Raises BadRecording when joints and readings have nothing in common.
    """
    return Samples(**paired_columns(recording, names, rules))


def as_recording(samples: Samples, names: tuple[str, ...]) -> Recording:
    """Joint states and readings of samples of these joints, in the form that checks ask for."""
    unknown = np.full(len(samples), np.nan)
    joints = JointTrack(names, samples.stamps, samples.q, samples.velocity, samples.effort, unknown)
    readings = []
    for f, frame in enumerate(samples.frames):
        for kind in samples.kinds:
            rows = (samples.frame == f) & (samples.kind == kind)
            T = se3.transform(samples.R[rows], samples.reading[rows])
            values = se3.to_pose(T) if kind == POSE else samples.reading[rows]
            readings.append(ReadingTrack(kind, frame, samples.stamps[rows], values, unknown[rows], "readings"))
    return Recording((joints,), tuple(readings), samples.signals, source="arrays")


# --- Whether the order of the stations goes with the posture: what changes in time may then change with the posture

_NEAREST = 3  # stations that are asked
_RIGHT = 0.95  # share of the stations that their neighbours in posture put on the right side of a moment
_MAX = 500  # stations that are asked; spread over the recording


def explained_by_posture(samples: Samples, at: float) -> tuple[str, ...]:
    """Joints whose position alone tells whether a station comes before a moment [s] or after it, by those that are
    nearest to it in that joint. Where the order has nothing to do with the joint, half of them are right.
    """
    first = np.unique(samples.station, return_index=True)[1]  # several instruments read at each
    rows = first[spread_rows(len(first), _MAX)]
    after = samples.stamps[rows] >= at
    if min(after.sum(), (~after).sum()) <= _NEAREST:
        return ()
    return tuple(name for j, name in enumerate(samples.names) if _told(samples.q[rows, j], after) >= _RIGHT)


def joints_instead(samples: Samples, at: float) -> tuple[str, ...]:
    """Names, as in ``same_as``, of the joints' errors that may be what seems to have happened at a moment [s]."""
    return tuple(f"{name} axis by position:{name}" for name in explained_by_posture(samples, at))


def _told(q: np.ndarray, after: np.ndarray) -> float:
    """Share of the stations that the nearest others in q (n,) put on the right side, both sides weighing the same."""
    gap = np.abs(q[:, None] - q[None])
    np.fill_diagonal(gap, np.inf)
    near = np.argsort(gap, axis=1, kind="stable")[:, :_NEAREST]
    right = (after[near].mean(axis=1) > 0.5) == after
    return float(0.5 * (right[after].mean() + right[~after].mean()))


# --- Marks of readings, by which a recording is known again

_KEPT = 256  # marks: a recording that holds a twentieth of these samples shares a dozen of them
_FINEST = 1e-6  # m, rad, s; far above what another reader rounds, far below what an arm repeats and a clock counts
_POSTURE, _TENTH = 1e-3, 1e-4  # rad or m, m: of marks that rounding spares
_BITS = np.uint64(16)  # taken off, so that a mark is a number that any reader of YAML keeps


def marks_of(samples: Samples) -> tuple[int, ...]:
    """The least of the samples' marks, in order, at most 256, and as many of rounded positions (odd numbers)."""
    kept = [np.unique(marks)[:_KEPT] for marks in (_marks(samples), _rounded_marks(samples))]
    return tuple(np.concatenate(kept).tolist())


def share_of_known(marks: tuple[int, ...], samples: Samples, rounded: bool = False) -> tuple[float, int]:
    """Which share of the samples, and of how many, is in the recording that had these marks; 0 without marks.

    rounded: of positions to 0.1 mm, at postures to a milliradian, at whatever time. Copies that were written with fewer
    digits agree in nearly all; new readings agree in some, where the arm came back.
    """
    kept = np.array([m for m in marks if m % 2 == rounded], int)
    own = _rounded_marks(samples) if rounded else _marks(samples)
    comparable = own if len(kept) < _KEPT else own[own <= kept[-1]]
    return (float(np.isin(comparable, kept).mean()), len(comparable)) if len(kept) and len(comparable) else (0.0, 0)


def _rounded_marks(samples: Samples) -> np.ndarray:
    """Odd marks of positions that were read, (n,)."""
    read = np.array([frame not in samples.sockets for frame in samples.frames])[samples.frame]
    rows = read & (samples.is_pose | (samples.kind == POINT))
    return _numbered(np.column_stack([samples.q[rows] / _POSTURE, samples.reading[rows] / _TENTH])) + np.uint64(1)


def _marks(samples: Samples, timed: bool = True) -> np.ndarray:
    """An even number for each sample, (N,): of its posture, its reading, and the time if that is one."""
    time = samples.stamps[:, None] if samples.clock and timed else np.empty((len(samples), 0))
    return _numbered(np.concatenate([samples.q, samples.reading, samples.R.reshape(-1, 9), time], axis=1) / _FINEST)


def _numbered(values: Array) -> np.ndarray:
    """An even number of 48 bits for each row of values (N, K), of their whole parts."""
    with np.errstate(over="ignore"):
        digits = np.round(values).astype(np.int64).view(np.uint64)
        mark = np.zeros(len(digits), np.uint64)
        for column in digits.T:  # splitmix64 (Steele, Lea and Flood 2014)
            mark = mark + column + np.uint64(0x9E3779B97F4A7C15)
            mark = (mark ^ (mark >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            mark = (mark ^ (mark >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            mark = mark ^ (mark >> np.uint64(31))
    return (mark >> _BITS) & ~np.uint64(1)


# --- Recordings one after the other, as they are joined to one

_COPIES = 0.2  # share; a ball that rests at one place may read alike now and then, postures do not come back exactly


def after(other: Samples, before: Samples) -> tuple[Samples, float]:
    """The samples of another recording, and by how much [s] they were put later so as not to run into those before.

    Where they overlap in time, clocks differ or count rows: they are put one typical step behind, signals and all.
    """
    low, high = float(other.stamps.min()), float(other.stamps.max())
    if low > before.stamps.max() or high < before.stamps.min():
        return other, 0.0
    steps = np.diff(np.unique(before.stamps))
    late = float(before.stamps.max()) + (float(np.median(steps)) if len(steps) else 1.0) - low
    signals = tuple(replace(track, stamps=track.stamps + late) for track in other.signals)
    return replace(other, stamps=other.stamps + late, signals=signals, clock=False), late


def require_new(other: Samples, before: Samples, name: str) -> None:
    """Raises BadRecording where another recording repeats readings of those before to the last digit: given again, its
    stations would count as returns that repeat perfectly, and as witnesses of what they were fitted to.
    """
    copies = int(np.isin(_marks(other, False), _marks(before, False)).sum())
    if copies > _COPIES * len(other):
        said = f"is a copy: {copies} of its {len(other)} readings are those of a recording before it, to the last digit"
        raise BadRecording(f"--also {name}", said, "give each recording once")


def between(before: Samples, other: Samples) -> float:
    """The moment [s] in the middle between two recordings that do not overlap."""
    first, second = sorted((before, other), key=lambda s: float(s.stamps.min()))
    return 0.5 * float(first.stamps[first.stamps < second.stamps.min()].max() + second.stamps.min())


def indirect_rows(samples: Samples) -> np.ndarray:
    """True for readings that are no positions, (N,)."""
    out = np.zeros(len(samples), bool)
    for name in samples.kinds:
        if not kinds()[name].direct:
            out |= samples.kind == name
    return out


def dimensions(samples: Samples) -> Array:
    """In how many directions each reading sees, (N,)."""
    out = np.empty(len(samples))
    for name in samples.kinds:
        out[samples.kind == name] = kinds()[name].dimensions
    return out

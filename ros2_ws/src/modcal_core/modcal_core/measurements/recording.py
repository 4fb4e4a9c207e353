"""A recording: everything a bag or a running cell said, as arrays, before any of it is judged.

Tracks keep the stamps of the messages (seconds since the epoch, as float64 they resolve 0.2 µs) and, where known,
the time each message was received, which is how a clock that is off shows itself.

A command holds until the next one. Commands that come close together are points of a course, and are interpolated.
Where joint states are notes of stations, a command noted right behind belongs to the same station.

What was told rather than seen (a payload, a tool's number) comes when something changes, in round numbers, and holds
until the next message; between two of them there is no course. What a sensor saw is interpolated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.geometry import Array, se3

POSE, POINT, RANGE, BEARING, TOUCH, RAY = "pose", "point", "range", "bearing", "touch", "ray"
# Notes of a recording that say what its readings are, as `modcal import` writes them
ORDER_ONLY = "The table has no clock: stamps give the order of the rows only, not when they were taken."
SOCKETS = "Sockets, in each of which the tool's ball rests at one point: "
TARGETS = "Another target on the tool from these stamps [s] on: "
IMPORTED = "Imported from tables by "
ARM = "The arm that was measured, from link to link: "
_BETWEEN = " → "
UNREAD = "The bag also holds "
PART = "#"  # between the topic and the field, in the name of a signal that is one of many numbers in a message


def noted(notes: Sequence[str], what: str) -> list[str]:
    """What notes that begin with these words say behind them."""
    return [note.removeprefix(what).rstrip(".") for note in notes if note.startswith(what)]


@dataclass(frozen=True)
class _Track:
    """What has a row for each message in all of its arrays, stamps among them."""

    def rows(self, keep: NDArray[Any] | slice) -> Self:
        """The track with these rows only, by a mask, their numbers or a slice."""
        return replace(self, **{name: x[keep] for name, x in vars(self).items() if isinstance(x, np.ndarray)})

    def in_order(self) -> Self:
        """The track in the order of its stamps."""
        return self.rows(np.argsort(vars(self)["stamps"], kind="stable"))

    def followed_by(self, *others: Self) -> Self:
        """The track with the rows of others behind its own; what only some of them state is NaN in the rest."""
        columns: dict[str, Any] = {}
        counts = [len(vars(track)["stamps"]) for track in (self, *others)]
        for name in vars(self):
            parts = [vars(track)[name] for track in (self, *others)]
            width = next((x.shape[1:] for x in parts if isinstance(x, np.ndarray)), None)
            if width is not None:
                parts = [np.full((n, *width), np.nan) if x is None else x for n, x in zip(counts, parts, strict=True)]
                columns[name] = np.concatenate(parts)
        return replace(self, **columns)


@dataclass(frozen=True)
class JointTrack(_Track):
    """Joint states of one publisher: the same names in every row.

    stamps (m,) [s]; position, velocity, effort (m, n) [rad or m, per s, N m or N], NaN columns where not sent;
    received (m,) [s], NaN where unknown.
    """

    names: tuple[str, ...]
    stamps: Array
    position: Array
    velocity: Array
    effort: Array
    received: Array
    topic: str = "/joint_states"


@dataclass(frozen=True)
class ReadingTrack(_Track):
    """Readings of one instrument in one frame. kind: one of measurements/kinds. values: (m, 7)
    x y z qx qy qz qw for poses, as many numbers as the kind has for others, in m and unit length. frame: the readings'
    frame_id. stated: what the instrument says of its own error at each reading, RMS over space of position [m] and
    angle [rad], (m, 2), NaN where it says nothing; None: nowhere. by_type: whether nobody named the topic.
    """

    kind: str
    frame: str
    stamps: Array
    values: Array
    received: Array
    topic: str = "/tracker/pose"
    stated: Array | None = None
    by_type: bool = False


@dataclass(frozen=True)
class SignalTrack(_Track):
    """Any other recorded numbers that an error may depend on. values (m, k)."""

    name: str
    stamps: Array
    values: Array
    topic: str = ""


@dataclass(frozen=True)
class Listed:
    """A topic of a recording. count: messages, None if nobody counted. role: what it is used as.

    could: roles that it could play if somebody said so.
    """

    topic: str
    type_name: str
    count: int | None = None
    role: str | None = None
    could: tuple[str, ...] = ()


@dataclass(frozen=True)
class Recording:
    """Joint states, readings and signals of one recording, and what was noticed while reading it.

    listed: all topics that there are. lost: messages that could not be read, counted by reason. commands: positions
    that joints were told to take, those of the preferred topic first.
    """

    joints: tuple[JointTrack, ...] = ()
    readings: tuple[ReadingTrack, ...] = ()
    signals: tuple[SignalTrack, ...] = ()
    robot_description: str | None = None
    source: str = "recording"
    warnings: tuple[str, ...] = field(default=())
    listed: tuple[Listed, ...] = ()
    lost: tuple[tuple[str, int], ...] = ()
    commands: tuple[JointTrack, ...] = ()

    @property
    def duration(self) -> float:
        """Seconds from the first stamp to the last of joint states and readings; 0 when there are none."""
        tracks: tuple[JointTrack | ReadingTrack, ...] = (*self.joints, *self.readings)
        stamps = [t.stamps for t in tracks if len(t.stamps)]
        return float(max(s.max() for s in stamps) - min(s.min() for s in stamps)) if stamps else 0.0

    @property
    def has_clock(self) -> bool:
        """Whether stamps are times; False where they are only an order, as a note says."""
        return ORDER_ONLY not in self.warnings

    @property
    def sockets(self) -> tuple[str, ...]:
        """Frames that a note states to be sockets."""
        return tuple(name for names in noted(self.warnings, SOCKETS) for name in names.split(", "))

    @property
    def arm(self) -> tuple[str, str] | None:
        """Base and tip links of the arm that was measured, where `modcal import` noted them."""
        base, arrow, tip = next(iter(noted(self.warnings, ARM)), "").partition(_BETWEEN)
        return (base, tip) if arrow else None

    def of_arm(self, base: str, tip: str) -> Recording:
        """The same with a note of the arm's base and tip links."""
        return replace(self, warnings=(*self.warnings, f"{ARM}{base}{_BETWEEN}{tip}."))

    @property
    def tool_changes(self) -> tuple[float, ...]:
        """Stamps [s] at which a note states that another target on the tool is measured."""
        return tuple(float(stamp) for stamps in noted(self.warnings, TARGETS) for stamp in stamps.split(", "))

    @property
    def frames(self) -> tuple[str, ...]:
        """Distinct frames of the readings, in order of appearance."""
        return tuple(dict.fromkeys(r.frame for r in self.readings))


@dataclass(frozen=True)
class Stretch:
    """A stretch of a recording that is too long to be held whole. Only samples between since and until (stamps of joint
    states [s]) are its own; it goes on a little at either end, so that what happens there is seen whole.
    """

    recording: Recording
    since: float = -np.inf
    until: float = np.inf


def joints_by_time(recording: Recording, names: tuple[str, ...], *more: str) -> tuple[Array, ...]:
    """Stamps (m,), in their order, and positions (m, n) of the named joints, NaN where there is no such joint.

    more: "velocity" and "effort", whose columns follow. All may be the recording's own, not to be written to. Joints of
    several publishers are interpolated onto the stamps of the one that carries most of them.
    """
    tracks = sorted(_of_one_order(recording.joints), key=lambda t: (-sum(n in t.names for n in names), -len(t.stamps)))
    if not tracks:
        return (np.empty(0), *(np.empty((0, len(names))) for _ in ("position", *more)))
    first = tracks[0] if (np.diff(tracks[0].stamps) >= 0.0).all() else tracks[0].in_order()
    out = [first.stamps]
    for what in ("position", *more):
        if first.names == names:
            out.append(getattr(first, what))
            continue
        columns = np.full((len(first.stamps), len(names)), np.nan)
        for j, name in enumerate(names):
            track = next((track for track in (first, *tracks[1:]) if name in track.names), None)
            if track is not None:
                column = getattr(track, what)[:, track.names.index(name)]
                columns[:, j] = column if track is first else np.interp(first.stamps, track.stamps, column)
        out.append(columns)
    return tuple(out)


def _of_one_order(tracks: tuple[JointTrack, ...]) -> list[JointTrack]:
    """The tracks with those put together that carry the same joints of one topic in different orders."""
    groups: dict[tuple[str, frozenset[str]], list[JointTrack]] = {}
    for track in tracks:
        groups.setdefault((track.topic, frozenset(track.names)), []).append(track)
    return [same[0] if len(same) == 1 else _merged(same) for same in groups.values()]


def _merged(tracks: list[JointTrack]) -> JointTrack:
    """One track in the order of stamps, of tracks that name the same joints in different orders."""
    names, columns = tracks[0].names, list[JointTrack]()
    for track in tracks:
        order = [track.names.index(name) for name in names]
        position, velocity, effort = (x[:, order] for x in (track.position, track.velocity, track.effort))
        columns.append(replace(track, names=names, position=position, velocity=velocity, effort=effort))
    return columns[0].followed_by(*columns[1:]).in_order()


# --- What joints were told beside what they reported: commanded − measured at each sample

_COURSE = 0.1  # s between commands up to which they are points of one course; controllers are told more often
_NOTES = 0.5  # s between joint states from which they are notes of stations; drivers report many times a second
_BEHIND = 0.1  # s within which messages of one note follow each other, far below the time to the next station
_NEARER = 0.5  # times as far from what was told; a command of another station is farther by orders of magnitude
_FARTHEST = 0.2  # rad or m; a joint that is farther away does not follow this command: other units, or led by hand


def commanded_at(tracks: Sequence[JointTrack], names: Sequence[str], stamps: Array) -> Array:
    """Commanded positions (N, n) [rad, m] of the named joints at the stamps (N,) [s], by the first of these tracks that
    tells; NaN where nothing was commanded.
    """
    out = np.full((len(stamps), len(names)), np.nan)
    for j, name in enumerate(names):
        for track in tracks:
            if name in track.names:
                told = _held(track.stamps, track.position[:, track.names.index(name)], stamps)
                out[:, j] = np.where(np.isfinite(out[:, j]), out[:, j], told)
    return out


def following(tracks: Sequence[JointTrack], names: Sequence[str], t: Array, q: Array, spans: Array) -> Array:
    """Commanded − measured (N, n) [rad, m], NaN where unknown, averaged over the joint states in spans (N, 2) [s], and
    interpolated to one of no length. t: stamps of joint states, sorted, (m,); q: positions (m, n).
    """
    if not len(t) or not any(name in track.names for track in tracks for name in names):
        return np.full((len(spans), len(names)), np.nan)
    apart = _apart(tracks, names, t, q)
    apart[np.abs(apart) > _FARTHEST] = np.nan
    first, last = np.searchsorted(t, spans[:, 0]), np.searchsorted(t, spans[:, 1], side="right")
    at = spans.mean(axis=1)
    once = np.stack([np.interp(at, t, column, left=np.nan, right=np.nan) for column in apart.T], axis=1)
    return np.where((last - first > 1)[:, None], means_between(apart, first, last), once)


def means_between(x: Array, first: np.ndarray, last: np.ndarray) -> Array:
    """Means of the finite ones among rows first … last − 1 of columns (m, n), (N, n); NaN where there are none."""
    known, none = np.isfinite(x), np.zeros((1, x.shape[1]))
    parts = np.where(known, x, 0.0), known
    total, count = (np.concatenate([none, np.cumsum(part, axis=0)]) for part in parts)
    within = count[last] - count[first]
    return np.asarray((total[last] - total[first]) / np.where(within > 0.0, within, np.nan))


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


# --- Tracks of a recording from plain arrays, checked, with the row in every refusal

APART = 10.0  # s between rows without stamps: far more than a window of dwells, so that each is a station
_UNIT = 0.02  # by which the length of a quaternion may be off 1


def joints_of(
    q: ArrayLike, names: Sequence[str] | None, stamps: ArrayLike | None, efforts: ArrayLike | None
) -> JointTrack:
    """Joint states: one row a posture, APART seconds between them where no stamps are given. Raises BadRecording."""
    positions = _numbers("q", q, (None, None))
    N, n = positions.shape
    if N == 0:
        raise NotEnoughData("arrays", "hold no row", "give one posture and one reading a row")
    if names is not None and (len(names) != n or len(set(names)) != n):
        raise BadRecording("names", f"{len(set(names))} names for {n} columns of q", "give each column a name")
    columns = tuple(f"column_{j}" for j in range(n)) if names is None else tuple(names)
    t: Array = APART * np.arange(N, dtype=float) if stamps is None else _numbers("stamps", stamps, (N,))
    if not (np.diff(t) > 0.0).all():
        row = int(np.argmax(np.diff(t) <= 0.0)) + 1
        raise BadRecording("stamps", f"do not increase at row {row}", "give rows in the order of time")
    unknown = np.full((N, n), np.nan)
    effort = unknown if efforts is None else _numbers("efforts", efforts, (N, n))
    return JointTrack(columns, t, positions, unknown, effort, np.full(N, np.nan))


def commands_of(commanded: ArrayLike | None, joints: JointTrack) -> tuple[JointTrack, ...]:
    """Commanded positions beside these joint states, row by row; none where none are given. Raises BadRecording."""
    if commanded is None:
        return ()
    told, unknown = _numbers("commanded", commanded, joints.position.shape), np.full(joints.position.shape, np.nan)
    return (JointTrack(joints.names, joints.stamps, told, unknown, unknown, joints.received, "arrays"),)


def readings_of(
    points: ArrayLike | None, poses: ArrayLike | None, ranges: Mapping[str, ArrayLike] | None, t: Array, frame: str
) -> list[ReadingTrack]:
    """The readings at these stamps; rows that are not finite are left out. Raises BadRecording unless some are left."""
    given = [name for name, x in (("points", points), ("poses", poses), ("ranges", ranges)) if x is not None]
    if len(given) != 1:
        said = "none of points, poses and ranges is given" if not given else f"{' and '.join(given)} are given"
        raise BadRecording("arrays", said, "give one of them; join samples of several with followed_by")
    tracks: list[tuple[str, str, Array]] = []
    if points is not None:
        tracks.append((POINT, frame, _numbers("points", points, (len(t), 3), finite=False)))
    elif poses is not None:
        tracks.append((POSE, frame, _poses(poses, len(t))))
    else:
        for anchor, distances in (ranges or {}).items():
            tracks.append((RANGE, anchor, _numbers(f"ranges to {anchor}", distances, (len(t),), finite=False)[:, None]))
    out = []
    for kind, name, values in tracks:
        good = np.isfinite(values).all(axis=1)
        out.append(ReadingTrack(kind, name, t[good], values[good], np.full(int(good.sum()), np.nan), "arrays"))
    if not any(len(track.stamps) for track in out):
        raise BadRecording("arrays", "hold no reading that is finite", "give what the instrument saw")
    return out


def _poses(poses: ArrayLike, N: int) -> Array:
    """Poses x y z qx qy qz qw (N, 7) from these or from matrices (N, 4, 4). Raises BadRecording."""
    values = np.asarray(poses, dtype=float)
    if values.shape == (N, 4, 4):
        R = values[:, :3, :3]
        off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2)) + (np.linalg.det(R) < 0.0)
        if (off > 1e-3).any():
            raise BadRecording(f"pose of row {int(np.argmax(off))}", "is not a rotation matrix", "give rotations")
        out = np.full((N, 7), np.nan)
        good = np.isfinite(values).all(axis=(1, 2))
        out[good] = se3.to_pose(values[good])
        return out
    if values.shape != (N, 7):
        said = f"have shape {values.shape}, not ({N}, 4, 4) or ({N}, 7)"
        raise BadRecording("poses", said, "give matrices, or x y z qx qy qz qw")
    length = np.linalg.norm(values[:, 3:], axis=1)
    if (np.abs(length - 1.0) > _UNIT).any():
        row = int(np.argmax(np.abs(length - 1.0)))
        raise BadRecording(f"quaternion of row {row}", f"has length {length[row]:.4g}, not 1", "give unit quaternions")
    return values


def signals_of(kind: str, given: Mapping[str, ArrayLike] | None, t: Array) -> list[SignalTrack]:
    """Temperatures or signals at these stamps, by name. Raises BadRecording."""
    return [
        SignalTrack(f"{kind}:{name}", t, _numbers(f"{kind} {name}", values, (len(t),))[:, None], kind)
        for name, values in (given or {}).items()
    ]


def sigma_of(name: str, given: ArrayLike | None, stamps: Array, t: Array, found: Array) -> Array:
    """Standard deviations of samples with these stamps, (N,): as given, one for all or one for each t, or as found."""
    if given is None:
        return found
    values = np.asarray(given, dtype=float)
    if not (np.isfinite(values).all() and (values > 0.0).all() and values.shape in ((), t.shape)):
        raise BadRecording(name, "is neither one positive number nor one for each row", "give standard deviations")
    if values.shape == ():
        return np.full(len(stamps), float(values))
    rows = np.searchsorted(t, stamps)
    if not np.array_equal(t[np.minimum(rows, len(t) - 1)], stamps):
        raise BadRecording(name, "is given by row, but rows were averaged over dwells", "give one number")
    return values[rows]


def _numbers(name: str, values: ArrayLike, shape: tuple[int | None, ...], finite: bool = True) -> Array:
    """An array of finite numbers of this shape, None standing for any number. Raises BadRecording."""
    try:
        out = np.array(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise BadRecording(name, f"is not an array of numbers ({error})", "give numbers") from error
    if out.ndim != len(shape) or any(count not in (None, has) for count, has in zip(shape, out.shape, strict=True)):
        wanted = str(shape).replace("None", "any")
        raise BadRecording(name, f"has shape {out.shape}, not {wanted}", "give one row a posture, one number a column")
    if finite and not np.isfinite(out).all():
        row = int(np.argmin(np.isfinite(out.reshape(len(out), -1)).all(axis=1)))
        raise BadRecording(f"{name}, row {row}", "is not finite", "leave such rows out")
    return out


# --- Signals that say what was told rather than what a sensor saw: a payload, a tool's number, an output on or off

_DIGITS = 4  # significant ones that people write; a sensor's floating-point number has seven or more
_SAME = 1e-6  # relative; rounding of single precision is a tenth of it
_JUMP = 0.05  # of the range, from one message to the next, usually; what is sampled often enough changes by less


def is_told(x: Array) -> bool:
    """Whether values (m,) in the order of their stamps are round numbers that jump from message to message."""
    if len(x) < 2 or not np.ptp(x) > 0.0:
        return False
    known = np.abs(x[x != 0.0])
    with np.errstate(over="ignore", invalid="ignore"):  # numbers near the ends of what is a number are not round
        scaled = known * 10.0 ** (_DIGITS - 1 - np.floor(np.log10(known)))
        is_round = bool(np.all(np.abs(scaled - np.round(scaled)) <= _SAME * scaled))
    return is_round and float(np.median(np.abs(np.diff(x)))) > _JUMP * float(np.ptp(x))


def told_at(t: Array, x: Array, stamps: Array, moving: np.ndarray) -> Array:
    """What holds at the stamps (N,) [s] of values x (m,) told at rising t (m,); the first before that.

    moving: samples (N,) taken in motion; at all others what is told just behind belongs to the same station.
    """
    at = stamps + np.where(moving, 0.0, _BEHIND)
    return np.asarray(x[np.maximum(np.searchsorted(t, at, side="right") - 1, 0)])


def staircase(t: Array, x: Array, step: float) -> tuple[Array, Array]:
    """The same commands as a course that rises within a step [s] before each message, stamps (2 m − 1,) and values."""
    before = np.maximum(t[1:] - step, t[:-1])
    return np.sort(np.r_[t, before]), np.repeat(x, 2)[:-1]

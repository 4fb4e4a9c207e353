"""A recording: everything a bag or a running cell said, as arrays, before any of it is judged.

Tracks keep the stamps of the messages (seconds since the epoch, as float64 they resolve 0.2 µs) and, where known,
the time each message was received, which is how a clock that is off shows itself.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modcal_core.geometry.so3 import Array

POSE, POINT, RANGE, BEARING, TOUCH, RAY = "pose", "point", "range", "bearing", "touch", "ray"
# Notes of a recording that say what its readings are, as `modcal import` writes them
ORDER_ONLY = "The table has no clock: stamps give the order of the rows only, not when they were taken."
SOCKETS = "Sockets, in each of which the tool's ball rests at one point: "
IMPORTED = "Imported from tables by "
PART = "#"  # between the topic and the field, in the name of a signal that is one of many numbers in a message


@dataclass(frozen=True)
class JointTrack:
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
class ReadingTrack:
    """Readings of one instrument in one frame.

    kind: one of measurements/kinds, of which pose, point, range, bearing, touch and ray have names here. values: (m, 7)
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

    def rows(self, keep: NDArray[Any]) -> ReadingTrack:
        """The track with these readings only."""
        stated = None if self.stated is None else self.stated[keep]
        columns = {name: getattr(self, name)[keep] for name in ("stamps", "values", "received")}
        return replace(self, stated=stated, **columns)


@dataclass(frozen=True)
class SignalTrack:
    """Any other recorded numbers that an error may depend on. values (m, k)."""

    name: str
    stamps: Array
    values: Array
    topic: str = ""


@dataclass(frozen=True)
class Listed:
    """A topic of a recording. count: messages, None where nobody counted. role: what it is used as.

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
        stated = [note.removeprefix(SOCKETS).rstrip(".") for note in self.warnings if note.startswith(SOCKETS)]
        return tuple(name for names in stated for name in names.split(", "))

    @property
    def frames(self) -> tuple[str, ...]:
        """Distinct frames of the readings, in order of appearance."""
        return tuple(dict.fromkeys(r.frame for r in self.readings))


@dataclass(frozen=True)
class Stretch:
    """A stretch of a recording that is too long to be held whole.

    It begins a little before ``since`` and goes on a little after ``until`` (stamps of joint states [s]), so that what
    happens there is seen whole; but only samples between the two are this piece's own.
    """

    recording: Recording
    since: float = -np.inf
    until: float = np.inf


def joint_stamps_and_positions(recording: Recording, names: tuple[str, ...]) -> tuple[Array, Array]:
    """Stamps (m,) and positions (m, n) of the named joints, whichever publishers and orders they came in."""
    return joint_stamps_and(recording, names, "position")


def joint_stamps_and(recording: Recording, names: tuple[str, ...], what: str) -> tuple[Array, Array]:
    """Stamps (m,) and position, velocity or effort (m, n) of the named joints.

    Joints spread over several publishers are interpolated onto the stamps of the one that carries most of them.
    Missing joints are left to the caller's checks: their columns are NaN.
    """
    tracks = sorted(_of_one_order(recording.joints), key=lambda t: (-sum(n in t.names for n in names), -len(t.stamps)))
    if not tracks:
        return np.empty(0), np.empty((0, len(names)))
    stamps = tracks[0].stamps
    position = np.full((len(stamps), len(names)), np.nan)
    for j, name in enumerate(names):
        for track in tracks:
            if name in track.names:
                column = getattr(track, what)[:, track.names.index(name)]
                same = track is tracks[0]
                position[:, j] = column if same else np.interp(stamps, track.stamps, column)
                break
    return stamps, position


def _of_one_order(tracks: tuple[JointTrack, ...]) -> list[JointTrack]:
    """The tracks with those put together that carry the same joints of one topic in different orders."""
    groups: dict[tuple[str, frozenset[str]], list[JointTrack]] = {}
    for track in tracks:
        groups.setdefault((track.topic, frozenset(track.names)), []).append(track)
    return [same[0] if len(same) == 1 else _merged(same) for same in groups.values()]


def _merged(tracks: list[JointTrack]) -> JointTrack:
    names = tracks[0].names
    stamps = np.concatenate([t.stamps for t in tracks])
    order = np.argsort(stamps, kind="stable")

    def column(what: str) -> Array:
        parts = [getattr(t, what)[:, [t.names.index(n) for n in names]] for t in tracks]
        return np.concatenate(parts)[order]

    received = np.concatenate([t.received for t in tracks])[order]
    return JointTrack(
        names, stamps[order], column("position"), column("velocity"), column("effort"), received, tracks[0].topic
    )

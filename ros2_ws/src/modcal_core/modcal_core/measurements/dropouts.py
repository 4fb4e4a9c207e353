"""Messages of a recording that say nothing: numbers that are not finite or cannot be, lost targets, lost clocks.

They are left out, counted and said. Where they are more than single wrong readings, the verdict is open for it; where
nothing is left, or most messages are wrong in the same way (millimetres), the recording is refused.

Alone a run of equal readings says little: a coarse instrument repeats itself at rest, a bridge that publishes faster
than its tracker does so in motion. It must last, and the arm must have been elsewhere meanwhile.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TypeVar

import numpy as np

from modcal_core.errors import BadRecording
from modcal_core.geometry import Array
from modcal_core.measurements.alignment import without_bursts
from modcal_core.measurements.checks import joint_limits
from modcal_core.measurements.dwells import LEFT, StationRules, dwells_of, inliers
from modcal_core.measurements.kinds.kind import farthest
from modcal_core.measurements.kinds.registry import kinds
from modcal_core.measurements.recording import POSE, JointTrack, ReadingTrack, Recording, SignalTrack, joints_by_time
from modcal_core.measurements.samples import Samples
from modcal_core.robots import JointColumns, Mechanism

JOINTS = "joint states without a finite position"
BEYOND = "joint states with a position that no joint has"
READINGS = "readings that are not finite"
TARGETS = "readings without a target (a quaternion of zeros)"
IMPLAUSIBLE = "readings that cannot be (too far away, or not of unit length)"
ELSEWHEN = "stamped at another time than all others"
_LOST = 1e-6  # length of the quaternion of a tracker that has lost its target
_SAID = 0.5  # share that is left out from which it is worth a warning of its own
_MAX = 0.5  # share of implausible readings beyond which the plausible ones are the exception
MAX_GLITCHES = 0.05  # share that may be single wrong readings, as of rejected stations; more make the verdict open
_UNITS = {"millimetres": 1e3, "centimetres": 1e2, "inches": 1.0 / 0.0254}  # of a metre
_WITHIN = 0.8  # share of the implausible readings that are plausible in another unit, from which they are in it
_NO_RATE = 1e6  # N m, N or per second; no actuator exerts so much
_NO_DEGREES = 1e4  # rad or m; larger than any joint's position, in whatever unit
DAY, _SPREADS = 86_400.0, 40.0  # s, and usual distances from the middle: a stamp farther off is of another time

_AnyTrack = TypeVar("_AnyTrack", JointTrack, ReadingTrack)


@dataclass(frozen=True)
class Cleaned:
    """A recording of what says something, a sentence for each topic, and what was left out, by reason.

    doubts: the same sentences of topics that are wrong too often for single wrong messages; they make a verdict open.
    spread: frames whose readings came in bursts.
    """

    recording: Recording
    notes: tuple[str, ...] = ()
    lost: tuple[tuple[str, int], ...] = ()
    doubts: tuple[str, ...] = ()
    spread: tuple[str, ...] = ()


def cleaned(recording: Recording, names: tuple[str, ...], chain: Mechanism | None = None) -> Cleaned:
    """The recording without messages that say nothing of these joints, or of the target.

    chain: the arm, where it is known: what it cannot reach is left out too, as far as it is an exception. Raises
    BadRecording where nothing is left of a track that is needed.
    """
    recording = _followed(recording, chain)
    ledger = _Ledger(dict(recording.lost))
    joints = tuple(_joints(track, names, chain, ledger) for track in recording.joints)
    reach = 0.0 if chain is None else chain.reach()
    as_stamped = tuple(_readings(track, reach, ledger) for track in recording.readings)
    readings = tuple(without_bursts(track, f"{track.topic} ({track.frame})", ledger.notes) for track in as_stamped)
    spread = tuple(old.frame for old, new in zip(as_stamped, readings, strict=True) if new is not old)
    clean = replace(recording, joints=joints, readings=readings, signals=tuple(map(_signals, recording.signals)))
    return Cleaned(clean, tuple(ledger.notes), tuple(ledger.lost.items()), tuple(ledger.doubts), spread)


@dataclass
class _Ledger:
    """What is left out of a recording: how many messages by reason, a sentence for each topic, and those sentences that
    make a verdict open.
    """

    lost: dict[str, int]
    notes: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)

    def kept(self, track: _AnyTrack, name: str, faults: Mapping[str, tuple[np.ndarray, str]]) -> _AnyTrack:
        """The track without faulty rows. faults: by reason the rows (m,) that have it, and what is said."""
        wrong = np.any([rows for rows, _ in faults.values()], axis=0)
        for reason, (rows, what) in faults.items():
            if (count := int(rows.sum())) == 0:
                continue
            self.lost[reason] = self.lost.get(reason, 0) + count
            much = f", {100.0 * rows.mean():.0f} % of them" if rows.mean() > _SAID else ""
            first = float(track.stamps[int(np.argmax(rows))])
            said = f"{name}: {what} in {count} of {len(rows)} messages{much}, first at {first:.3f} s: left out"
            self.notes.append(f"{said}.")
            if reason in (BEYOND, IMPLAUSIBLE) and count > MAX_GLITCHES * int((rows | ~wrong).sum()):
                self.doubts.append(f"{said}, and too often for single wrong messages.")
        return track.rows(~wrong) if wrong.any() else track


def _followed(recording: Recording, chain: Mechanism | None) -> Recording:
    """The recording with joints that mimic another one, where their own positions were not recorded."""
    known = {name for track in recording.joints for name in track.names}
    new = () if chain is None else [f for f in chain.follows if chain.names[f.joint] not in known]
    if chain is None or not new:
        return recording
    tracks = []
    for track in recording.joints:
        told = JointColumns.of(chain.names, new, track.names)
        led = ~told.own
        whole = {
            "position": np.c_[track.position, told.positions(track.position)[:, led]],
            "velocity": np.c_[track.velocity, told.velocities(track.velocity)[:, led]],
            "effort": np.c_[track.effort, told.efforts(track.effort)[:, led]],
        }
        tracks.append(replace(track, names=(*track.names, *(chain.names[j] for j in told.joints[led])), **whole))
    return replace(recording, joints=tuple(tracks))


def elsewhen(stamps: Array) -> np.ndarray:
    """True for the few stamps (m,) that lie far from all others, as those of a clock that was not set for a moment."""
    if len(stamps) < 3:
        return np.zeros(len(stamps), dtype=np.bool_)
    off = np.abs(stamps - np.median(stamps))
    far = np.asarray(~(off <= max(DAY, _SPREADS * float(np.median(off)))))
    return far if far.sum() <= max(1.0, MAX_GLITCHES * len(stamps)) else np.zeros(len(stamps), dtype=np.bool_)


def _joints(track: JointTrack, names: tuple[str, ...], chain: Mechanism | None, ledger: _Ledger) -> JointTrack:
    """The rows of a track that say where the named joints are that it carries."""
    mine = [j for j, name in enumerate(track.names) if name in names]
    bad = ~np.isfinite(track.position[:, mine])

    def worst(cells: np.ndarray) -> str:
        return track.names[mine[int(np.argmax(cells.sum(axis=0)))]] if mine else ""

    broken: np.ndarray = np.any(bad, axis=1)
    if mine and broken.all() and len(broken):
        said = f"position is not finite in any of {len(broken)} messages"
        raise BadRecording(f"joint {worst(bad)}", said, "correct the driver, or record again")
    other = elsewhen(track.stamps) & ~broken
    beyond = _beyond(track, mine, chain)
    far: np.ndarray = beyond.any(axis=1) & ~broken & ~other
    faults = {
        JOINTS: (broken, f"no finite position of {worst(bad)}"),
        f"joint states {ELSEWHEN}": (other, ELSEWHEN),
        BEYOND: (far, f"a position beyond its range of {worst(beyond[far])}"),
    }
    return _with_rates(ledger.kept(track, track.topic, faults), mine, ledger.notes)


def _beyond(track: JointTrack, mine: list[int], chain: Mechanism | None) -> np.ndarray:
    """Where a position is one that the joint cannot have, (m, len(mine)): a glitch, not an arm that speaks degrees."""
    size = np.abs(track.position[:, mine])
    surely = size > _NO_DEGREES
    if surely.any(axis=1).mean() > _MAX if len(size) else True:
        return np.zeros(size.shape, dtype=np.bool_)
    if chain is None:
        return np.asarray(surely)
    known = dict(zip(chain.names, joint_limits(chain), strict=True))
    over = size > np.array([known.get(track.names[j], np.inf) for j in mine])
    return np.asarray(over if over.any(axis=1).mean() <= MAX_GLITCHES else surely)


def _with_rates(track: JointTrack, mine: list[int], notes: list[str]) -> JointTrack:
    """The track with velocities and efforts that are finite or, for a whole joint, unknown; where a few are not, those
    before and after stand in.
    """
    changed: dict[str, Array] = {}
    for what in ("velocity", "effort"):
        values = getattr(track, what)
        known = np.abs(values[:, mine]) < _NO_RATE
        some = known.any(axis=0) & ~known.all(axis=0)
        if not some.any():  # all of them, or none, as of a driver that sends none
            continue
        values = values.copy()
        order = np.argsort(track.stamps, kind="stable")
        for k in np.flatnonzero(some).tolist():
            j, good, n = mine[k], known[:, k], int((~known[:, k]).sum())
            few = n <= MAX_GLITCHES * len(good)
            kept = order[good[order]]
            values[~good, j] = np.interp(track.stamps[~good], track.stamps[kept], values[kept, j]) if few else np.nan
            done = "the neighbouring values replace it" if few else "it counts as unknown there"
            at = float(track.stamps[int(np.argmax(~good))])
            notes.append(
                f"{track.topic}: the {what} of {track.names[j]} is not finite, or cannot be, in {n} of {len(good)} "
                f"messages, first at {at:.3f} s: {done}."
            )
        changed[what] = values
    return replace(track, velocity=changed.get("velocity", track.velocity), effort=changed.get("effort", track.effort))


def _readings(track: ReadingTrack, reach: float, ledger: _Ledger) -> ReadingTrack:
    """The readings of a track that are finite and plausible, and that have an orientation where there is one."""
    if track.kind not in kinds() or not len(track.stamps):
        return track
    broken: np.ndarray = ~np.all(np.isfinite(track.values), axis=1)
    gone: np.ndarray = np.zeros(len(broken), dtype=np.bool_)
    if track.kind == POSE:
        with np.errstate(invalid="ignore", over="ignore"):
            gone = ~broken & (np.linalg.norm(track.values[:, 3:], axis=1) < _LOST)
    whole = ~(broken | gone)
    name = f"{track.topic} ({track.frame})"
    if not whole.any():
        why = "not finite" if broken.all() else "not finite, or without a target,"
        said = f"{why} in all of {len(whole)} readings"
        raise BadRecording(name, said, "check that the instrument sees its target, and record again")
    other = elsewhen(track.stamps) & whole
    odd: np.ndarray = np.zeros(len(whole), dtype=np.bool_)
    odd[whole] = kinds()[track.kind].implausible(track.values[whole], reach)
    odd &= ~other
    if odd.sum() > _MAX * whole.sum():
        odd[:] = False  # what is wrong with them is said when they are checked
    elif odd.sum() > MAX_GLITCHES * whole.sum():
        _require_one_unit(track, whole, odd, reach)
    faults = {
        READINGS: (broken, "not finite"),
        TARGETS: (gone, "without a target"),
        f"readings {ELSEWHEN}": (other, ELSEWHEN),
        IMPLAUSIBLE: (odd, "too far away, or not of unit length,"),
    }
    return ledger.kept(track, name, faults)


def _require_one_unit(track: ReadingTrack, whole: np.ndarray, odd: np.ndarray, reach: float) -> None:
    """Raises BadRecording where the implausible ones of whole readings are plausible with another unit in some cells:
    what is left may hold such numbers as well, which are only small enough to be metres.
    """
    if not kinds()[track.kind].direct:
        return
    kind, good = kinds()[track.kind], track.values[whole & ~odd, :3]
    large = np.abs(track.values[odd, :3]) > farthest(reach)
    usual, room = np.median(good, axis=0), reach + np.ptp(good, axis=0)
    found: list[tuple[float, str]] = []
    for unit, size in _UNITS.items():
        values = track.values[odd].copy()
        whole_ones = values[:, :3] / size  # or some coordinates of them alone
        there = (np.abs(whole_ones - usual) < room).all(axis=1, keepdims=True)
        values[:, :3] = np.where(there | large, whole_ones, values[:, :3])
        near = (np.abs(values[:, :3] - usual) < room).all(axis=1)
        if (~kind.implausible(values, reach) & near & large.any(axis=1)).mean() >= _WITHIN:
            apart = np.log(np.median(np.linalg.norm(values[:, :3], axis=1)) / np.linalg.norm(usual))
            found.append((abs(float(apart)), unit))
    if not found:
        return
    n, of, first = int(odd.sum()), int(whole.sum()), float(track.stamps[int(np.argmax(odd))])
    columns = " and ".join(axis for axis, some in zip("xyz", large.T, strict=True) if some.any())
    which = "" if large.all(axis=1).mean() > _WITHIN else f" in {columns}"
    raise BadRecording(
        f"{track.topic} ({track.frame})",
        f"units are mixed: {n} of {of} readings hold numbers{which} that look like {min(found)[1]}, beside "
        f"others in metres, first at {first:.3f} s",
        "write all positions in metres, and record or export again",
    )


def _signals(track: SignalTrack) -> SignalTrack:
    """A signal without values that are not finite, and stamps of another time."""
    keep = np.isfinite(track.values).all(axis=1) & ~elsewhen(track.stamps)
    return track if keep.all() or not keep.any() else track.rows(keep)


# --- Readings of a tracker that hangs: the same pose to the last bit, with new stamps, while the joints go on

HUNG = "readings repeated while the joints moved"
_MIN = 5  # equal readings in a row
_LASTS = 1.0  # s; trackers that are read slower than once a second are read at stations
_HUNG_MAX = 0.5  # share of all; beyond, the topic is none of the target, and is refused as such


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
    """What a tracker, on the joints' clock, repeated while it hung; of each run the first reading is none of them."""
    t, q = joints_by_time(recording, names)
    found, notes, doubts = [], [], []
    for track in recording.readings:
        rows = _repeated(track, t, q)
        count = int(rows.sum())
        if count > _HUNG_MAX * len(rows):
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


# --- Readings that were recorded and never became part of a sample, counted by reason

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
    """How many readings stamped within [since, until) are in none of these samples of the recording, by reason."""
    t, q = joints_by_time(recording, samples.names)
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
    track = track.in_order()
    ordered, values, own = track.stamps, track.values[:, :3], np.sort(stamps)
    within, wrong = 0, 0
    for (first, last), rows in zip(np.searchsorted(own, dwells), np.searchsorted(ordered, dwells), strict=True):
        if last > first:
            within += int(last - first)
            wrong += int((~inliers(values[slice(*rows)])).sum())
    return within, wrong

"""Messages of a recording that say nothing: joint positions and readings that are not finite, targets that were lost.

They are left out, counted and said. A recording is refused when nothing is left, or too little for what is asked of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.errors import BadRecording
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.kinds.registry import kinds
from modcal_core.measurements.recording import POSE, JointTrack, ReadingTrack, Recording

JOINTS = "joint states without a finite position"
READINGS = "readings that are not finite"
TARGETS = "readings without a target (a quaternion of zeros)"
_LOST = 1e-6  # length of the quaternion of a tracker that has lost its target
_SAID = 0.5  # share that is left out from which it is worth a warning of its own


@dataclass(frozen=True)
class Cleaned:
    """A recording of what says something, a sentence for each topic, and what was left out, by reason."""

    recording: Recording
    notes: tuple[str, ...] = ()
    lost: tuple[tuple[str, int], ...] = ()


def cleaned(recording: Recording, names: tuple[str, ...]) -> Cleaned:
    """The recording without messages that say nothing of these joints, or of the target.

    Raises BadRecording where nothing is left of a track that is needed.
    """
    notes: list[str] = []
    lost = dict(recording.lost)
    joints = tuple(_joints(track, names, notes, lost) for track in recording.joints)
    readings = tuple(_readings(track, notes, lost) for track in recording.readings)
    if all(a is b for a, b in zip((*joints, *readings), (*recording.joints, *recording.readings), strict=True)):
        return Cleaned(recording, (), tuple(lost.items()))
    return Cleaned(replace(recording, joints=joints, readings=readings), tuple(notes), tuple(lost.items()))


def _joints(track: JointTrack, names: tuple[str, ...], notes: list[str], lost: dict[str, int]) -> JointTrack:
    """The rows of a track that say where the named joints are that it carries."""
    mine = [j for j, name in enumerate(track.names) if name in names]
    bad = ~np.isfinite(track.position[:, mine])
    rows: np.ndarray = np.any(bad, axis=1)
    if not rows.any():
        return track
    worst = mine[int(np.argmax(bad.sum(axis=0)))]
    if rows.all():
        said = f"position is not finite in any of {len(rows)} messages"
        raise BadRecording(f"joint {track.names[worst]}", said, "correct the driver, or record again")
    _count(lost, JOINTS, int(rows.sum()))
    notes.append(_sentence(track.topic, rows, track.stamps, f"no finite position of {track.names[worst]}"))
    keep = ~rows
    columns = {name: getattr(track, name)[keep] for name in ("stamps", "position", "velocity", "effort", "received")}
    return replace(track, **columns)


def _readings(track: ReadingTrack, notes: list[str], lost: dict[str, int]) -> ReadingTrack:
    """The readings of a track that are finite, and that have an orientation where there is one."""
    if track.kind not in kinds() or not len(track.stamps):
        return track
    broken: np.ndarray = ~np.all(np.isfinite(track.values), axis=1)
    gone: np.ndarray = np.zeros(len(broken), dtype=np.bool_)
    if track.kind == POSE:
        with np.errstate(invalid="ignore", over="ignore"):
            gone = ~broken & (np.linalg.norm(track.values[:, 3:], axis=1) < _LOST)
    rows = broken | gone
    if not rows.any():
        return track
    name = f"{track.topic} ({track.frame})"
    if rows.all():
        why = "not finite" if broken.all() else "not finite, or without a target,"
        said = f"{why} in all of {len(rows)} readings"
        raise BadRecording(name, said, "check that the instrument sees its target, and record again")
    for reason, those, what in ((READINGS, broken, "not finite"), (TARGETS, gone, "without a target")):
        if those.any():
            _count(lost, reason, int(those.sum()))
            notes.append(_sentence(name, those, track.stamps, what))
    return track.rows(~rows)


def _sentence(name: str, rows: np.ndarray, stamps: Array, what: str) -> str:
    first = float(stamps[int(np.argmax(rows))])
    share = rows.mean()
    much = f", {100.0 * share:.0f} % of them" if share > _SAID else ""
    return f"{name}: {what} in {int(rows.sum())} of {len(rows)} messages{much}, first at {first:.3f} s: left out."


def _count(lost: dict[str, int], reason: str, n: int) -> None:
    lost[reason] = lost.get(reason, 0) + n

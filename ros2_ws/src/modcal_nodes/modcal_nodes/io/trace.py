"""What a report is traced back to, taken from a bag."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

from modcal_core.errors import BadRobot
from modcal_core.measurements.dropouts import elsewhen
from modcal_core.measurements.recording import JointTrack, ReadingTrack, Recording
from modcal_core.report.trace import Trace, iso_date
from modcal_core.robots.urdf_tree import document

_MAX_NAMED = 4  # instruments; a cell of many anchors would fill the line
_CHUNK = 1 << 20


def trace_of(bag: Path, recording: Recording, robot: str | None = None, frames: Iterable[str] = ()) -> Trace:
    """The trace of a report on this bag.

    recording: of its beginning. robot: the name of the arm; None takes that of the recorded description. frames: those
    whose readings were used; none given: all.
    """
    first = began(recording)
    return Trace(
        date=None if first is None else iso_date(first),
        bag_sha256=digest(bag),
        robot=robot or _robot(recording),
        instrument=_instruments(recording, set(frames)),
    )


def began(recording: Recording) -> float | None:
    """The first stamp of joint states and readings [s], but for those of another time; None where there are none."""
    tracks: tuple[JointTrack | ReadingTrack, ...] = (*recording.joints, *recording.readings)
    stamps = [t.stamps[~elsewhen(t.stamps)] for t in tracks]
    return min((float(s.min()) for s in stamps if len(s)), default=None)


def digest(bag: Path) -> str:
    """SHA-256 of a bag: of its file, or of what ``sha256sum`` prints of a folder's files in order of their names."""
    if bag.is_file():
        return _digest_of(bag)
    lines = (f"{_digest_of(file)}  {file.name}\n" for file in sorted(bag.iterdir()) if file.is_file())
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _digest_of(file: Path) -> str:
    digits = hashlib.sha256()
    with file.open("rb") as stream:
        while chunk := stream.read(_CHUNK):
            digits.update(chunk)
    return digits.hexdigest()


def _robot(recording: Recording) -> str | None:
    if recording.robot_description is None:
        return None
    try:
        return document(recording.robot_description).get("name")
    except BadRobot:  # evaluate does not need the description, and says elsewhere that it cannot be read
        return None


def _instruments(recording: Recording, frames: set[str]) -> str | None:
    tracks = [t for t in recording.readings if not frames or t.frame in frames]
    named = list(dict.fromkeys(f"{t.kind} on {t.topic} in {t.frame}" for t in tracks))
    if len(named) > _MAX_NAMED:
        named = [*named[:_MAX_NAMED], f"{len(named) - _MAX_NAMED} more"]
    return "; ".join(named) or None

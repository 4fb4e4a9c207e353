"""What a report is traced back to, taken from a bag."""

from __future__ import annotations

import hashlib
from pathlib import Path

from modcal_core.measurements.dropouts import elsewhen
from modcal_core.measurements.recording import JointTrack, ReadingTrack, Recording

_MAX_NAMED = 4  # instruments; a cell of many anchors would fill the line
_CHUNK = 1 << 20


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


def instruments(recording: Recording, frames: set[str]) -> str | None:
    """Kind, topic and frame of the readings in these frames, all of them where none are given; None: no readings."""
    tracks = [t for t in recording.readings if not frames or t.frame in frames]
    named = list(dict.fromkeys(f"{t.kind} on {t.topic} in {t.frame}" for t in tracks))
    if len(named) > _MAX_NAMED:
        named = [*named[:_MAX_NAMED], f"{len(named) - _MAX_NAMED} more"]
    return "; ".join(named) or None

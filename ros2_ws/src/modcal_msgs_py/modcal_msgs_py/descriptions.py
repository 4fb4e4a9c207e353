"""The robot descriptions of a recording, and the one of them that belongs to the joints that were recorded."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

from modcal_core.measurements import JointTrack, ReadingTrack, Recording, elsewhen
from modcal_msgs_py.topics import ROBOT_DESCRIPTION, preferred

_MAX_DESCRIPTIONS = 8  # different ones that are kept of a topic


class Descriptions:
    """URDF texts by the topic that brought them."""

    def __init__(self) -> None:
        self._texts: dict[str, list[str]] = {}

    def add(self, topic: str, text: str) -> None:
        """Keep a robot description, if it is another one than those before."""
        kept = self._texts.setdefault(topic, [])
        if text not in kept and len(kept) < _MAX_DESCRIPTIONS:
            kept.append(text)

    def chosen(self, joints: tuple[JointTrack, ...]) -> tuple[str | None, list[str]]:
        """The description that has most of the recorded joints, the earlier of equals; and what to say of others."""
        topics = sorted(preferred(set(self._texts), ROBOT_DESCRIPTION))
        texts = [(topic, text) for topic in topics for text in self._texts[topic]]
        if not texts:
            return None, []
        names = {name for track in joints for name in track.names}

        def known(text: str) -> int:
            return sum(f'"{name}"' in text or f"'{name}'" in text for name in names)

        topic, chosen = max(texts, key=lambda pair: known(pair[1]))  # the first of equals
        others = len(self._texts[topic]) - 1
        said = f"{topic} was published with {others + 1} different contents: the one with most recorded joints was used"
        return chosen, [f"{said}."] if others else []


def is_link(frame: str, description: str) -> bool:
    """Whether a robot description has a link of this name."""
    frame = frame.strip("/")
    return bool(frame) and re.search(rf"<link\b[^>]*\bname\s*=\s*[\"']{re.escape(frame)}[\"']", description) is not None


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

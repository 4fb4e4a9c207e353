"""The robot descriptions of a recording, and the one of them that belongs to the joints that were recorded."""

from __future__ import annotations

import re

from modcal_core.measurements.recording import JointTrack
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
        said = (
            f"{topic} was published with {others + 1} different contents: the one with most recorded joints was used."
        )
        return chosen, [said] if others else []


def is_link(frame: str, description: str) -> bool:
    """Whether a robot description has a link of this name."""
    frame = frame.strip("/")
    return bool(frame) and re.search(rf"<link\b[^>]*\bname\s*=\s*[\"']{re.escape(frame)}[\"']", description) is not None

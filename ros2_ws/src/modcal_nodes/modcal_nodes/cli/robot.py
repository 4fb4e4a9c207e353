"""Which robot a verb is about: its description, its base and its tip."""

from __future__ import annotations

from pathlib import Path

from modcal_core.errors import BadRobot
from modcal_core.measurements.recording import Recording
from modcal_core.robots.chain import Chain
from modcal_core.robots.urdf import read_chain


def robot_of(recording: Recording, urdf: Path | None, base: str | None, tip: str | None) -> tuple[Chain, str]:
    """The nominal arm and its URDF text: from a file, or else from the recording's robot_description."""
    text = recording.robot_description if urdf is None else urdf.read_text(encoding="utf-8", errors="replace")
    if text is None:
        raise BadRobot(recording.source, "holds no robot_description", "give --urdf FILE, or record the topic")
    recorded = frozenset(name for track in recording.joints for name in track.names)
    return read_chain(text, base, tip, recorded), text

"""What a report can be traced back to: the program, the recording, the arm and the instrument."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

from modcal_core.version import __version__


@dataclass(frozen=True)
class Trace:
    """date: the first stamp of the recording, ISO 8601 in UTC, so that two runs give the same bytes. bag_sha256: of the
    bag's file; of a folder, of the list that ``sha256sum`` prints of its files in order of their names. robot: the name
    in the description. instrument: kind of reading, topic and frame. None where not known.
    """

    version: str = __version__
    date: str | None = None
    bag_sha256: str | None = None
    robot: str | None = None
    instrument: str | None = None


def iso_date(stamp: float) -> str:
    """A stamp [s] as date and time, UTC."""
    return datetime.fromtimestamp(stamp, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")

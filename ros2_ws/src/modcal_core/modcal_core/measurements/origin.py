"""Where samples come from: what a report is traced back to, and what was noticed on the way to them."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Origin:
    """The origin of samples; all of it unknown where nothing is stated.

    title: name of the recording. notes: a sentence each, as text. dropped: readings that are in no sample, by
    reason. doubts: sentences on what was left out too often, which make a verdict open. began: first stamp of the
    recording [s]. sha256: of the bag. instrument: kind of reading, topic and frame. description: the recorded URDF.
    by_type: topics of readings that nobody named. instrument_mm, instrument_deg: what instruments state of their own
    error, where the data bear it out. checked: whether units and joints were compared with a robot.
    """

    title: str = "recording"
    notes: tuple[str, ...] = ()
    dropped: tuple[tuple[str, int], ...] = ()
    began: float | None = None
    sha256: str | None = None
    instrument: str | None = None
    description: str | None = field(default=None, repr=False)
    by_type: tuple[str, ...] = ()
    instrument_mm: float | None = None
    instrument_deg: float | None = None
    checked: bool = True
    doubts: tuple[str, ...] = ()

"""What is asked of a calibration; apart from what does it, so that saying so brings no mathematics along."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol


@dataclass(frozen=True)
class Options:
    """What is asked of a calibration, beside the recording: the options of ``modcal calibrate`` under their names.

    urdf, delta: files that describe the robot; None: the recording does. cell_file: what is known of the surroundings.
    clock_limit: [s]. repeatability_*, instrument_*: what is stated of arm and instrument [mm, deg]. tolerance_mm: the
    error allowed, of the statistic tolerance_of; None: none is asked for.
    """

    urdf: Path | None = None
    delta: Path | None = None
    base: str | None = None
    tip: str | None = None
    fixed: tuple[str, ...] = ()
    geometry_only: bool = False
    cell_file: Path | None = None
    block: int | None = None
    seed: int = 0
    clock_limit: float = 0.5
    repeatability_mm: float | None = None
    repeatability_deg: float | None = None
    repeatability_iso: float | None = None
    instrument_mm: float | None = None
    instrument_deg: float | None = None
    tolerance_mm: float | None = None
    tolerance_of: str = "p95"
    topic: tuple[str, ...] = ()
    ignore: tuple[str, ...] = ()
    tf: str | None = None
    factory_kinematics: Path | None = None


class Watch(Protocol):
    """Hears what is being done, and, where that is known, the share of it that is done."""

    def __call__(self, stage: str, share: float | None = None) -> None:
        """Take notice."""


def silent(stage: str, share: float | None = None) -> None:
    """A watch that says nothing."""

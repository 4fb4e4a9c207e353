"""What is asked of a calibration; apart from what does it, so that saying so brings no mathematics along."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Wishes:
    """What is asked of a calibration, beside the recording: the options of ``modcal calibrate`` under their names.

    urdf, delta: files that describe the robot; None: the recording does. cell_file: what is known of the surroundings.
    clock_limit: [s].
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

"""One recording of a fleet, and what becomes of it: what travels between processes and machines."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from modcal_nodes.io.options import Options

DONE, REFUSED, FAILED = "done", "refused", "failed"


@dataclass(frozen=True)
class Task:
    """A bag to calibrate, under this name."""

    name: str
    bag: Path
    options: Options


@dataclass(frozen=True)
class Outcome:
    """What became of a task. said: one line, where it was refused or failed. row: of the table. files: by name.

    took: seconds. trace: where a fault of our own happened.
    """

    name: str
    state: str
    said: str = ""
    row: dict[str, Any] = field(default_factory=dict)
    files: dict[str, bytes] = field(default_factory=dict)
    took: float = 0.0
    trace: str = ""

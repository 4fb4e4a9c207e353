"""How many recordings are calibrated at a time."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

JOB_BYTES = 1.0e9  # what one takes at most, however long the recording is: it is read in pieces
_CGROUP = Path("/sys/fs/cgroup")


@dataclass(frozen=True)
class Room:
    """cores: that this process may use. memory: bytes that are free; None where the system does not say."""

    cores: int
    memory: float | None

    @property
    def fits(self) -> int | None:
        """How many jobs the memory holds, at least one; None where it is not known."""
        return None if self.memory is None else max(1, int(self.memory / JOB_BYTES))

    @property
    def jobs(self) -> int:
        """One a core, as far as the memory goes."""
        return self.cores if self.fits is None else min(self.cores, self.fits)

    def said(self, jobs: int) -> str:
        """A line for a person."""
        if self.fits is None:
            return f"{jobs} at a time; {self.cores} cores"
        memory = f"memory for {self.fits} ({(self.memory or 0.0) / 1e9:.1f} GB free, {JOB_BYTES / 1e9:.0f} GB each)"
        return f"{jobs} at a time; {self.cores} cores, {memory}" + (
            ": that may be too many" if jobs > self.fits else ""
        )


def room() -> Room:
    """The room on this machine, within the limits of its container."""
    free = [x for x in (_available(), _left_in_container()) if x is not None]
    return Room(len(os.sched_getaffinity(0)), min(free) if free else None)


def _available() -> float | None:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return 1024.0 * next(float(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration, ValueError, IndexError):
        return None


def _left_in_container() -> float | None:
    try:
        return float((_CGROUP / "memory.max").read_text()) - float((_CGROUP / "memory.current").read_text())
    except (OSError, ValueError):  # no such file, or "max": no limit
        return None

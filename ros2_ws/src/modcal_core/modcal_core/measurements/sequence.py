"""Recordings one after the other, as they are joined to one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modcal_core.errors import BadRecording
from modcal_core.measurements.samples import Samples

_COPIES = 0.2  # share; a ball that rests at one place may read alike now and then, postures do not come back exactly


def after(other: Samples, before: Samples) -> tuple[Samples, float]:
    """The samples of another recording, and by how much [s] they were put later so as not to run into those before.

    Recordings of one arm cannot overlap in time: their stamps are of different clocks, or count rows. They are put one
    typical step between stations behind the others, signals and all.
    """
    low, high = float(other.stamps.min()), float(other.stamps.max())
    if low > before.stamps.max() or high < before.stamps.min():
        return other, 0.0
    steps = np.diff(np.unique(before.stamps))
    late = float(before.stamps.max()) + (float(np.median(steps)) if len(steps) else 1.0) - low
    signals = tuple(replace(track, stamps=track.stamps + late) for track in other.signals)
    return replace(other, stamps=other.stamps + late, signals=signals, clock=False), late


def require_new(other: Samples, before: Samples, name: str) -> None:
    """Raises BadRecording where another recording repeats readings of those before to the last digit.

    No instrument reads the same twice: it is the same recording, or a part of it, given again. Its stations would
    count as returns that repeat perfectly, and as witnesses of what they were fitted to.
    """
    known = {row.tobytes() for row in _told(before)}
    copies = sum(row.tobytes() in known for row in _told(other))
    if copies > _COPIES * len(other):
        raise BadRecording(
            f"--also {name}",
            f"is a copy: {copies} of its {len(other)} readings are those of a recording before it, to the last digit",
            "give each recording once",
        )


def _told(samples: Samples) -> np.ndarray:
    """Posture and reading of each sample, (N, n + 12)."""
    return np.ascontiguousarray(np.column_stack([samples.q, samples.reading, samples.R.reshape(-1, 9)]))


def between(before: Samples, other: Samples) -> float:
    """The moment [s] in the middle between two recordings that do not overlap."""
    first, second = sorted((before, other), key=lambda s: float(s.stamps.min()))
    return 0.5 * float(first.stamps[first.stamps < second.stamps.min()].max() + second.stamps.min())

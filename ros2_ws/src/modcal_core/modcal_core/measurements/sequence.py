"""Recordings one after the other, as they are joined to one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modcal_core.measurements.samples import Samples


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


def between(before: Samples, other: Samples) -> float:
    """The moment [s] in the middle between two recordings that do not overlap."""
    first, second = sorted((before, other), key=lambda s: float(s.stamps.min()))
    return 0.5 * float(first.stamps[first.stamps < second.stamps.min()].max() + second.stamps.min())

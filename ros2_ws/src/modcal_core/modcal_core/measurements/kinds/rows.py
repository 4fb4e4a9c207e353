"""What samples see, row by row: whether a reading is a position, and in how many directions it says something."""

from __future__ import annotations

import numpy as np

from modcal_core.geometry import Array
from modcal_core.measurements.kinds.registry import kinds
from modcal_core.measurements.samples import Samples


def indirect_rows(samples: Samples) -> np.ndarray:
    """True for readings that are no positions, (N,)."""
    out = np.zeros(len(samples), bool)
    for name in samples.kinds:
        if not kinds()[name].direct:
            out |= samples.kind == name
    return out


def dimensions(samples: Samples) -> Array:
    """In how many directions each reading sees, (N,)."""
    out = np.empty(len(samples))
    for name in samples.kinds:
        out[samples.kind == name] = kinds()[name].dimensions
    return out

"""Drivers: what a residual may depend on, as small sets of basis functions.

A driver has a name that people and reports use ("position:elbow_joint", "time") and columns (N, m), one per function.
Smooth dependence on a joint is a short Fourier series over the turn; a periodic error of many cycles a turn, as gears
and encoders make, is one sine and cosine at a frequency that has to be found.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples

SMOOTH_CYCLES = (1.0, 2.0, 3.0)
PERIODIC_CYCLES = tuple(float(k) for k in range(4, 321))
_LEAST_RANGE = 0.05  # rad or m; a joint that moved less drives nothing that could be told


@dataclass(frozen=True)
class Driver:
    """name: as in reports. columns: basis functions at the samples, (N, m). cycles: per turn, of a periodic driver."""

    name: str
    columns: Array
    cycles: float | None = None


def smooth_position(samples: Samples, joint: int) -> Driver | None:
    """Any smooth function of a joint's position; None for a joint that hardly moved."""
    q = samples.q[:, joint]
    if np.ptp(q) < _LEAST_RANGE:
        return None
    columns = [f(k * q) for k in SMOOTH_CYCLES for f in (np.sin, np.cos)]
    return Driver(f"position:{samples.names[joint]}", np.stack(columns, axis=1))


def periodic_position(samples: Samples, joint: int) -> list[Driver]:
    """One driver for each number of cycles a turn that the joint's range can hold at least one of."""
    q = samples.q[:, joint]
    least = 2.0 * np.pi / max(float(np.ptp(q)), 1e-9)
    return [
        Driver(f"position:{samples.names[joint]}", np.stack([np.sin(k * q), np.cos(k * q)], axis=1), k)
        for k in PERIODIC_CYCLES
        if k >= least
    ]


def smooth_time(samples: Samples) -> Driver | None:
    """Any slow function of time; None where all samples have one stamp."""
    t = samples.stamps - samples.stamps.min()
    span = float(t.max())
    if span <= 0.0:
        return None
    x = 2.0 * t / span - 1.0
    return Driver("time", np.stack([x, x * x, x**3], axis=1))

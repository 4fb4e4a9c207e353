"""What stations remember: how joints arrived at each, and what slipped under an earlier load."""

from __future__ import annotations

import numpy as np

from modcal_core.effects import Drivers
from modcal_core.geometry import Array
from modcal_core.measurements import UNKNOWN, WIDTHS, Samples, ahead

LOADS = np.array([0.3, 0.7, 1.3])  # of a load's spread; half the slack of what holds by friction


def last_moves(samples: Samples) -> Array:
    """By how much each joint moved from the station before, (N, n) [rad, m]; 0 at the first of a frame."""
    return since_last(samples, samples.q)


def since_last(samples: Samples, numbers: Array) -> Array:
    """What numbers (N, c) have changed by since the station before, (N, c)."""
    order = np.lexsort((samples.stamps, samples.frame))
    step = np.zeros_like(numbers)
    step[order[1:]] = np.diff(numbers[order], axis=0)
    return step


def paths(samples: Samples) -> Array:
    """The paths of the joints, (N, n, 2, widths); straight from station to station where none is known."""
    if (samples.path != UNKNOWN).any():
        return samples.path
    order = np.argsort(samples.stamps, kind="stable")
    out = np.empty_like(samples.path)
    out[order] = ahead(samples.q[order], WIDTHS, np.arange(len(samples)))
    return out


def slipped(samples: Samples, loads: Array) -> Array:
    """How far loads (k, N) are ahead of followers with play of several widths, (k × widths, N), in their spreads.

    What holds by friction and slips where its load grows too large (bolts, a clamp) keeps the rest. Loads are taken to
    go straight from station to station.
    """
    size = np.maximum(loads.std(axis=1, keepdims=True), 1e-12)
    order = np.argsort(samples.stamps, kind="stable")
    out = np.empty((len(loads), len(LOADS), len(samples)))
    out[..., order] = ahead((loads / size).T[order], LOADS, np.arange(len(samples))).mean(axis=2).transpose(1, 2, 0)
    return out.reshape(-1, len(samples))


def moments_on_base(drivers: Drivers) -> Array:
    """Moments about the base's x and y, of a weight at the tip and, where it is known, of the arm, (2 or 4, N)."""
    loads = [drivers.payload[0, d] for d in (3, 4)]
    if drivers.arm.weighed:
        loads += [drivers.gravity[0, d] for d in (3, 4)]
    return np.stack(loads)

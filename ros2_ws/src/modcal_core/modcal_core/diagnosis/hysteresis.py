"""What joints remember: how they arrived at each station, and hysteresis of any width.

A hysteresis is a sum of play operators of different widths (Prandtl 1928, Ishlinskii 1944): each follows the joint only
where it would otherwise lag by more than its width. A joint is taken to go straight from station to station.
"""

from __future__ import annotations

import numpy as np

from modcal_core.effects import Drivers
from modcal_core.geometry import Array
from modcal_core.measurements import Samples

WIDTHS = (0.05, 0.15, 0.4, 0.9, 1.8)  # rad or m; half the slack
LOADS = (0.3, 0.7, 1.3)  # of a load's spread; the same of what holds by friction


def last_moves(samples: Samples) -> Array:
    """By how much each joint moved from the station before, (N, n) [rad, m]; 0 at the first of a frame."""
    order = np.lexsort((samples.stamps, samples.frame))
    step = np.zeros_like(samples.q)
    step[order[1:]] = np.diff(samples.q[order], axis=0)
    return step


def play(samples: Samples, widths: tuple[float, ...] = WIDTHS) -> Array:
    """How far each joint is ahead of a follower with play, (n, widths, N) [rad, m], at most the width."""
    return ahead(samples, samples.q.T, widths)


def ahead(samples: Samples, numbers: Array, widths: tuple[float, ...]) -> Array:
    """The same of any numbers (k, N) of the samples, (k, widths, N), taken to go straight from station to station."""
    order = np.argsort(samples.stamps, kind="stable")
    x = np.repeat(numbers.T[order, :, None], len(widths), axis=2)
    least, most = x - widths, x + widths
    held = np.empty_like(x)
    now = x[0].copy()
    for low, high, out in zip(least, most, held, strict=True):
        np.maximum(now, low, out=now)
        np.minimum(now, high, out=now)
        out[...] = now
    ahead_of = np.empty((len(numbers), len(widths), len(samples)))
    ahead_of[..., order] = (x - held).transpose(1, 2, 0)
    return ahead_of


def slipped(samples: Samples, loads: Array) -> Array:
    """How far loads (k, N) are ahead of followers with play of several widths, (k × widths, N), in their spreads.

    What holds by friction and slips where its load grows too large (bolts, a clamp) keeps the rest.
    """
    size = np.maximum(loads.std(axis=1, keepdims=True), 1e-12)
    return ahead(samples, loads / size, LOADS).reshape(-1, len(samples))


def moments_on_base(drivers: Drivers) -> Array:
    """Moments about the base's x and y, of a weight at the tip and, where it is known, of the arm, (2 or 4, N)."""
    loads = [drivers.payload[0, d] for d in (3, 4)]
    if drivers.arm.weighed:
        loads += [drivers.gravity[0, d] for d in (3, 4)]
    return np.stack(loads)

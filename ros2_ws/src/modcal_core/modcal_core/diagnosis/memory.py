"""What joints remember: how they arrived at each station, and hysteresis of any width.

A hysteresis is a sum of play operators of different widths (Prandtl 1928, Ishlinskii 1944): each follows the joint only
where it would otherwise lag by more than its width. A joint is taken to go straight from station to station.
"""

from __future__ import annotations

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples

WIDTHS = (0.05, 0.15, 0.4, 0.9, 1.8)  # rad or m; half the slack


def last_moves(samples: Samples) -> Array:
    """By how much each joint moved from the station before, (N, n) [rad, m]; 0 at the first of a frame."""
    order = np.lexsort((samples.stamps, samples.frame))
    step = np.zeros_like(samples.q)
    step[order[1:]] = np.diff(samples.q[order], axis=0)
    return step


def play(samples: Samples, widths: tuple[float, ...] = WIDTHS) -> Array:
    """How far each joint is ahead of a follower with play, (n, widths, N) [rad, m], at most the width."""
    order = np.argsort(samples.stamps, kind="stable")
    q = samples.q[order].T[:, None]  # (n, 1, N)
    width = np.array(widths)[None]
    out = np.empty((q.shape[0], len(widths), len(samples)))
    held = np.repeat(q[..., 0], len(widths), axis=1)
    for k in range(len(samples)):
        held = np.clip(held, q[..., k] - width, q[..., k] + width)
        out[..., order[k]] = q[..., k] - held
    return out

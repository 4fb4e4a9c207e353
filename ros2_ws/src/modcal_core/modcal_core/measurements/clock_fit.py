"""The tracker's delay together with the point of the tip link that it sees.

The speed of the tracked point is |v + dR/dt r|, with v and R of the tip link and r the point in it. Speeds of the tip
alone peak at other times than those of a point a hand's length away, up to some milliseconds on twenty motions, so the
delay is fitted together with r, by Gauss-Newton on the speeds. Its standard deviation is the sandwich estimate over
stretches of time, which needs no model of the noise (Huber 1967; Liang and Zeger 1986).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from modcal_core.geometry.so3 import Array

_ROUNDS = 8  # of Gauss-Newton; three or four settle a start that is right to half a grid step
_SETTLED = 1e-6  # s, a last step far below what matters to any arm
_STRETCH = 2.0  # s over which errors of the speeds are taken to hang together: about one motion
_OUTLIER = 4.0  # robust standard deviations: one in 16 000 of a normal error lies beyond
_SLOW = 0.02  # m/s; at rest the speed says nothing of the delay
_NORMAL = 1.4826  # median of absolute values to standard deviation of a normal error
_FARTHEST = 1.0  # m, standard deviation of the point before it is fitted: tools are no longer
_MAX_STEPS = 2.5  # grid steps that the fit may move from its start, which the correlation has told to one
_SLOWLY = 15.0  # grid steps, of slow motions, whose correlation is flat, where the speeds then agree much better ...
_BETTER = 0.5  # ... so many times as far apart: a start that is right leaves nothing like that to be gained


@dataclass(frozen=True)
class ClockFit:
    """offset, std: seconds by which the readings are late. moved: speed of the fitted point on the grid (G,) [m/s]."""

    offset: float
    std: float
    moved: Array


def fit_offset(seen: Callable[[float], Array], velocity: Array, turning: Array, start: float, step: float) -> ClockFit:
    """The delay from a start, of which the correlation of speeds is sure to half a grid step.

    seen: speeds of the readings on the grid (G,) [m/s], NaN where unknown, were they late by so many seconds.
    velocity: of the tip (G, 3) [m/s]. turning: derivative of its rotation (G, 3, 3) [1/s]. step: of the grid [s]. Where
    the fit leaves the start behind, the start comes back, half a grid step uncertain.
    """
    point, offset, scales = np.zeros(3), start, []
    for _ in range(_ROUNDS):
        moved_by = velocity + turning @ point
        moved = np.linalg.norm(moved_by, axis=1)
        reported = seen(offset)
        slope = np.gradient(reported, step)
        error = reported - moved
        known = np.isfinite(error) & np.isfinite(slope) & np.isfinite(moved)
        if not (known & (moved > _SLOW)).any():
            return _as_started(start, velocity, step)
        scale = _NORMAL * float(np.median(np.abs(error[known & (moved > _SLOW)])))
        scales.append(scale)
        known[known] = np.abs(error[known]) <= max(_OUTLIER * scale, _SLOW)
        by_point = np.einsum("ni,nij->nj", moved_by[known], turning[known]) / np.maximum(moved[known], 1e-9)[:, None]
        rows, left = np.column_stack([by_point, -slope[known]]), error[known]
        prior = np.append(np.full(3, float(np.mean(left**2)) / _FARTHEST**2), 0.0)
        normal = rows.T @ rows + np.diag(prior)
        if not normal[3, 3] > 0.0 or np.linalg.cond(normal) > 1e15:
            return _as_started(start, velocity, step)
        change = np.linalg.solve(normal, rows.T @ left - prior * np.append(point, 0.0))
        point, offset = point + change[:3], offset + float(change[3])
        if abs(offset - start) > _SLOWLY * step:
            return _as_started(start, velocity, step)
        if abs(change[3]) < _SETTLED:
            break
    if abs(offset - start) > _MAX_STEPS * step and not scales[-1] < _BETTER * scales[0]:
        return _as_started(start, velocity, step)
    stretch = np.flatnonzero(known) // round(_STRETCH / step)
    scores = np.zeros((int(stretch[-1]) + 1, 4))
    np.add.at(scores, stretch, rows * left[:, None])
    spread = np.linalg.solve(normal, scores.T)
    std = float(np.sqrt(spread[3] @ spread[3]))
    return ClockFit(offset, std, np.linalg.norm(velocity + turning @ point, axis=1))


def _as_started(start: float, velocity: Array, step: float) -> ClockFit:
    return ClockFit(start, 0.5 * step, np.linalg.norm(velocity, axis=1))

"""Stations that agree with a nominal arm: base, tool and fit, and what is wrong with the other stations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import turns_left
from modcal_core.geometry import Array, se3
from modcal_core.measurements import Samples
from modcal_core.robots import Chain

ANGLE = 0.012  # rad; nominal arms turn their tips by some 3 mrad too far
OF_REACH = 0.006  # the same for positions


@dataclass(frozen=True)
class Placed:
    """Base (Y, t) and tool (X, x): orientations are Y A X, positions Y (A x) + t."""

    Y: Array
    X: Array
    x: Array
    t: Array

    def residual(self, A: Array, samples: Samples) -> tuple[Array, Array]:
        """Angles [rad] and distances [m] of samples from what poses A (N, 4, 4) of the tip say, (N,)."""
        gap = samples.reading - (se3.apply(A, self.x) @ self.Y.T + self.t)
        turn = turns_left(self.Y, A[:, :3, :3], self.X, samples.R)
        return np.where(samples.is_pose, np.linalg.norm(turn, axis=1), 0.0), np.linalg.norm(gap, axis=1)


def limits(chain: Chain) -> tuple[float, float]:
    """Angle [rad] and distance [m] that a nominal arm misses by at most."""
    return ANGLE, OF_REACH * chain.reach()


@dataclass(frozen=True)
class Disagreement:
    """what: a phrase naming what looks wrong. remedy: what to do. stations: how many, of how many."""

    what: str
    remedy: str
    stations: int
    of: int

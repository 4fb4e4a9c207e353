"""Outside the joint ranges that were seen another model speaks: curves over a joint's position are not known there.

The geometry beside curves is not the best without them. Whether the geometry that is best alone does better where no
curve was seen is read from the calibration's own recording, the outermost postures of which are left out of a fit of
either (:mod:`modcal_core.calibration.outermost`). It comes in over a twentieth of a radian, so that no command jumps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from modcal_core.effects.effect import Effect
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples

BLEND = 0.05  # rad or m beyond what was seen, over which the other model comes in


class Predicting(Protocol):
    """A model that predicts poses (N, 4, 4) of samples."""

    def predict_samples(self, samples: Samples) -> Array:
        """Poses of the tool as the readings of these samples should show them."""
        ...


@dataclass(frozen=True)
class Fallback:
    """The model outside, with the same frames, and where that is.

    low, high: ends of the joint ranges that were seen, (n,). curved: joints that curves depend on, (n,).
    """

    model: Predicting
    low: Array
    high: Array
    curved: np.ndarray

    def share(self, q: Array) -> Array:
        """How much of it counts at postures (N, n), in [0, 1], (N,): none inside, all of it from BLEND beyond."""
        beyond = np.maximum(np.maximum(self.low - q, q - self.high), 0.0)[:, self.curved]
        u = np.clip(beyond.max(axis=1, initial=0.0) / BLEND, 0.0, 1.0)
        return np.asarray(u * u * (3.0 - 2.0 * u))

    def blended(self, T: Array, samples: Samples) -> Array:
        """Poses (N, 4, 4) of the full model, replaced by this one as far as the samples lie outside."""
        share = self.share(samples.q)
        rows = np.flatnonzero(share > 0.0)
        if not len(rows):
            return T
        return between(T, rows, share[rows], self.model.predict_samples(samples.select(rows)))


def between(T: Array, rows: np.ndarray, share: Array, other: Array) -> Array:
    """Poses T (N, 4, 4), those of these rows moved by a share (m,) towards others (m, 4, 4)."""
    out = np.array(T)
    out[rows] = T[rows] @ se3.exp(share[:, None] * se3.log(se3.inverse(T[rows]) @ other))
    return out


def curved_joints(effects: tuple[Effect, ...], names: tuple[str, ...]) -> np.ndarray:
    """Which joints curves depend on, (n,)."""
    of = {part.partition(":")[2] for e in effects for part in e.driver.split(",") if part.startswith("position:")}
    return np.array([name in of for name in names])

"""Outside the joint ranges that were seen another model speaks: curves over a joint's position are not known there.

The geometry beside curves is not the best without them. Whether the geometry that is best alone does better where no
curve was seen is read from the calibration's own recording, the outermost postures of which are left out of a fit of
either (:mod:`modcal_core.calibration.outermost`); and wherever outside the full model hardly knows itself, geometry
alone speaks too (:mod:`modcal_core.calibration.doubt`). It comes in over a twentieth of a radian, so that no command
jumps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import Effect
from modcal_core.effects.registry import claimed
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples

BLEND = 0.05  # rad or m beyond what was seen, over which the other model comes in


class Predicting(Protocol):
    """A model that predicts poses (N, 4, 4) of samples."""

    def predict_samples(self, samples: Samples) -> Array:
        """Poses of the tool as the readings of these samples should show them."""
        ...


class Doubting(Protocol):
    """Says how much a model should be doubted."""

    def share(self, samples: Samples, drivers: Drivers | None = None) -> Array:
        """How much geometry alone should count instead at these samples, in [0, 1], (N,).

        drivers: of the samples, where they are known already.
        """
        ...


@dataclass(frozen=True)
class Fallback:
    """The model outside, with the same frames, and where that is.

    low, high: ends of the joint ranges that were seen, (n,). curved: joints that curves depend on, (n,). doubt: how
    much the full model should be doubted there; None: altogether.
    """

    model: Predicting
    low: Array
    high: Array
    curved: np.ndarray
    doubt: Doubting | None = None

    def share(self, samples: Samples, drivers: Drivers | None = None) -> Array:
        """How much of it counts at samples, in [0, 1], (N,): none inside, from BLEND beyond as much as is doubted.

        drivers: of the samples, where they are known already.
        """
        beyond = np.maximum(np.maximum(self.low - samples.q, samples.q - self.high), 0.0)[:, self.curved]
        u = np.clip(beyond.max(axis=1, initial=0.0) / BLEND, 0.0, 1.0)
        out = np.asarray(u * u * (3.0 - 2.0 * u))
        rows = np.flatnonzero(out > 0.0)
        if self.doubt is not None and len(rows):
            everywhere = len(rows) == len(out)
            some = (samples, drivers) if everywhere else (samples.select(rows), None)
            out[rows] *= self.doubt.share(*some)
        return out

    def blended(self, T: Array, samples: Samples) -> Array:
        """Poses (N, 4, 4) of the full model, replaced by this one in proportion to how far outside the samples are."""
        share = self.share(samples)
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
    """Which joints curves depend on, (n,); not the small ones that no report names, which end by themselves."""
    named = [e for e in effects if claimed(e)]
    of = {part.partition(":")[2] for e in named for part in e.driver.split(",") if part.startswith("position:")}
    return np.array([name in of for name in names])

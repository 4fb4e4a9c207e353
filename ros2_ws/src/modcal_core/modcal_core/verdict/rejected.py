"""What a score leaves out: how many stations, and what the error is with and without them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import Errors, ErrorSize
from modcal_core.measurements import Samples

_SINGLE = 0.03  # chance that a reading is wrong by itself: a reflection, a target that was lost
_SURE = 0.01  # chance of as many single wrong readings, below which they are something else


def too_many(wrong: np.ndarray, samples: Samples) -> bool:
    """Whether more stations hold a rejected sample (True, (N,)) than single wrong readings make up (binomial)."""
    from scipy.special import bdtrc

    count, of = len(np.unique(samples.station[wrong])), samples.stations
    return count > 0 and float(bdtrc(count - 1, of, _SINGLE)) < _SURE


@dataclass(frozen=True)
class Rejected:
    """RMS position error on held-out with the rejected readings and without them [mm]; None where there is nothing to
    tell it from. stations: with a rejected reading, of so many, in the whole recording (held-out where frozen).
    """

    with_mm: float | None
    without_mm: float | None
    stations: int
    of: int

    @property
    def share(self) -> float:
        """Share of the stations that were rejected."""
        return self.stations / max(self.of, 1)


def rejection(
    residuals: Errors, wrong: np.ndarray, samples: Samples, held_out: np.ndarray, frozen: bool = False
) -> Rejected:
    """What is rejected of these samples.

    residuals: errors of the samples held out. wrong: True for rejected samples, (N,). held_out: rows of those held out.
    frozen: whether only those were judged.
    """
    kept = ~wrong[held_out]
    return Rejected(
        _rms_mm(residuals.position_norm),
        _rms_mm(residuals.position_norm[kept]),
        len(np.unique(samples.station[wrong])),
        len(np.unique(samples.station[held_out])) if frozen else samples.stations,
    )


def _rms_mm(norms: np.ndarray) -> float | None:
    size = ErrorSize.of(1e3 * norms)
    return None if size is None else size.rms

"""Stations where joints stand where the calibration has never seen them: what differs there may be the calibration.

Its covariance says how well its parameters are known, not how well an arm of those parameters is the arm. Within the
ranges it was made from that has been tried; beyond, what it does not have may be as large as what it has corrected.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import Calibration, Model
from modcal_core.geometry import Array
from modcal_core.measurements import Samples, spread_rows

UNTRIED = "the calibration, beyond the joint ranges that it was made from"
_MAX = 0.5  # of the stations, beyond which what they say together is of places where nothing was tried
_MARGIN = 0.02  # of a range, as where samples outside are counted
_ASKED = 10  # stations of the calibration's own that are proposed: as many as a check is to have


@dataclass(frozen=True)
class BeyondRanges:
    """outside: how many of the stations stand beyond the ranges, of how many. corrected: RMS [m] at the tool by which
    the calibration differs from the nominal arm at these stations.
    """

    outside: int
    of: int
    corrected: float

    @property
    def mostly(self) -> bool:
        """Whether most of them do."""
        return self.outside > _MAX * self.of

    def doubts(self, moved_mm: float) -> bool:
        """Whether a change that moves the tool by so much [mm] may be what was not tried there."""
        return self.mostly and moved_mm < 1e3 * self.corrected


def beyond_ranges(calibration: Calibration, model: Model, samples: Samples) -> BeyondRanges:
    """How many of these stations stand where the calibration was not made. model: the frozen one, for these samples."""
    low, high = calibration.seen
    margin = _MARGIN * (high - low)
    first = np.unique(samples.station, return_index=True)[1]
    q = samples.q[first]
    out = ((q < low - margin) | (q > high + margin)).any(axis=1)
    frames = [calibration.nominal.frames.index(samples.frames[f]) for f in samples.frame[first].tolist()]
    nominal = calibration.nominal.predict(q, np.array(frames, dtype=int))[:, :3, 3]
    moved = model.predict_samples(samples.select(first))[:, :3, 3] - nominal
    return BeyondRanges(int(out.sum()), len(first), float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))))


def tried_stations(calibration: Calibration) -> Array:
    """Ten of the postures (k, n) that the calibration was made from."""
    return np.asarray(calibration.postures[spread_rows(len(calibration.postures), _ASKED)])

"""Which held-out samples are independent of each other."""

from __future__ import annotations

import numpy as np

from modcal_core.calibration.split import block_length, units_of_stations
from modcal_core.measurements.samples import Samples

_MIN_BLOCK = 5  # stations; the shortest that the split makes of a dense recording


def independent_units(samples: Samples, rows: np.ndarray, blocks: bool) -> np.ndarray:
    """A number for each of these rows of the samples, (k,), the same for rows whose errors may be alike.

    A station is a unit of its own, with others in its posture where there are many of them. Where stations are dense,
    neighbours in time are neighbours in posture: there a unit is a run of neighbours, no longer than a block of the
    split. blocks: whether the split made blocks.
    """
    if not len(rows):
        return np.empty(0, int)
    _, first, station = np.unique(samples.station, return_index=True, return_inverse=True)
    order = np.argsort(samples.stamps[first], kind="stable")
    length = block_length(samples)
    if length == 1 and not blocks:
        return np.asarray(units_of_stations(samples)[1][station[rows]])
    rank = np.empty(len(order), int)
    rank[order] = np.arange(len(order))
    taken = np.unique(rank[station[rows]])
    run = np.cumsum(np.r_[0, np.diff(taken) > 1])
    within = np.arange(len(taken)) - np.searchsorted(run, run)
    unit = np.zeros(len(order), int)
    unit[taken] = run * len(order) + within // max(length, _MIN_BLOCK)
    return np.asarray(unit[rank[station[rows]]])

"""What a score leaves out: how many readings, what the error is with and without them, and whether they stand in runs.

A wrong reading stands alone. Neighbours in time that are rejected together are no outliers: something happened there.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, lgamma

import numpy as np

from modcal_core.calibration.score import Errors, ErrorSize
from modcal_core.diagnosis.evidence import independent_unit
from modcal_core.measurements.samples import Samples

MOST_SINGLE = 0.05  # share of readings up to which rejected ones are taken for single wrong readings
LEAST_RUN = 3  # neighbours
_CHANCE = 0.01  # that as many rejections, scattered at random, make a run as long anywhere

Runs = tuple[tuple[int, int], ...]


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


def rejection(missed: Errors, wrong: np.ndarray, samples: Samples, held_out: np.ndarray) -> Rejected:
    """What is rejected of these samples.

    missed: errors of the samples held out. wrong: True for rejected samples, (N,). held_out: rows of those held out.
    """
    kept = ~wrong[held_out]
    return Rejected(
        _rms_mm(missed.position_norm),
        _rms_mm(missed.position_norm[kept]),
        len(np.unique(samples.station[wrong])),
        samples.stations,
    )


def rejected_runs(samples: Samples, wrong: np.ndarray) -> Runs:
    """Runs (first, last station, counted in order of time) of neighbours that are rejected together.

    wrong: True for rejected samples, (N,). At least three in a row, seen through one frame, in a run that as many
    rejections scattered at random would hold anywhere with a chance below 1 %. In motion neighbours share their noise:
    there half a second counts as one.
    """
    if not wrong.any():
        return ()
    number = station_numbers(samples)
    unit = independent_unit(samples)
    runs: set[tuple[int, int]] = set()
    for f in np.unique(samples.frame[wrong]):
        rows = np.flatnonzero(samples.frame == f)
        rows = rows[np.argsort(samples.stamps[rows], kind="stable")]
        first, index = np.unique(unit[rows], return_index=True, return_inverse=True)[1:]
        rank = np.argsort(np.argsort(first))[index]  # of each row's unit, in order of time
        count = int(rank.max()) + 1
        share = np.bincount(rank, wrong[rows], count) / np.bincount(rank, minlength=count)
        bad = share > 0.5
        for a, b in consecutive(bad):
            if b - a >= LEAST_RUN and chance_of_run(b - a, int(bad.sum()), count) < _CHANCE:
                inside = number[rows[(rank >= a) & (rank < b)]]
                runs.add((int(inside.min()), int(inside.max())))
    return tuple(sorted(runs))


def chance_of_run(length: int, rejected: int, of: int) -> float:
    """An upper bound of the chance that so many rejections scattered among ``of`` places make a run of this length.

    The expected number of runs: each of ``of − length + 1`` stretches is rejected as a whole with the chance
    C(of − length, rejected − length) / C(of, rejected).
    """
    if length > rejected:
        return 0.0
    log = _log_choose(of - length, rejected - length) - _log_choose(of, rejected)
    return min(1.0, (of - length + 1) * exp(log))


def consecutive(flags: np.ndarray) -> list[tuple[int, int]]:
    """(first, end) of every stretch of True in flags (N,)."""
    edges = np.flatnonzero(np.diff(np.r_[False, flags, False].astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def station_numbers(samples: Samples) -> np.ndarray:
    """For each sample the number of its station in order of time, (N,)."""
    stations, index = np.unique(samples.station, return_inverse=True)
    first = np.full(len(stations), np.inf)
    np.minimum.at(first, index, samples.stamps)
    return np.asarray(np.argsort(np.argsort(first, kind="stable"), kind="stable")[index])


def _log_choose(n: int, k: int) -> float:
    return lgamma(n + 1) - lgamma(k + 1) - lgamma(n - k + 1)


def _rms_mm(norms: np.ndarray) -> float | None:
    size = ErrorSize.of(1e3 * norms)
    return None if size is None else size.rms

"""Stations in order of time or of a joint, and runs of them: whether neighbours were rejected together by chance."""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, lgamma

import numpy as np

from modcal_core.measurements.returns import posture_numbers
from modcal_core.measurements.samples import Samples

MIN_RUN = 3  # neighbours
CHANCE = 0.01  # that as many rejections, scattered at random, make a run as long anywhere

_MEMORY = 0.5  # s; samples in motion closer than this share their noise


@dataclass(frozen=True)
class RejectedPlace:
    """Stations that were rejected together, next to each other by a joint's position. joint: which. low, high: its
    position at these [rad or m]. stations: how many.
    """

    joint: str
    low: float
    high: float
    stations: int


def independent_unit(samples: Samples) -> np.ndarray:
    """For each sample the number of the unit whose noise is independent of the others', (N,).

    A station, with those after it in the same posture: several readings of one stop share what the arm does not repeat.
    In motion, where noise has a memory, all samples of half a second.
    """
    key = np.where(samples.moving, np.floor(samples.stamps / _MEMORY), _stops(samples))
    return np.unique(np.stack([samples.moving, key]), axis=1, return_inverse=True)[1].ravel()


def _stops(samples: Samples) -> np.ndarray:
    """For each sample the number of the stop that its station belongs to: stations in sequence in one posture, (N,)."""
    number = station_numbers(samples)
    first = np.unique(number, return_index=True)[1]
    posture = posture_numbers(samples.q[first])
    return np.asarray(np.cumsum(np.r_[0, np.diff(posture) != 0])[number])


def station_numbers(samples: Samples) -> np.ndarray:
    """For each sample the number of its station in order of time, (N,)."""
    return in_order_of_time(samples.station, samples.stamps)


def in_order_of_time(unit: np.ndarray, stamps: np.ndarray) -> np.ndarray:
    """For each sample the number of its unit, counted in order of the units' first stamps, (N,)."""
    units, index = np.unique(unit, return_inverse=True)
    first = np.full(len(units), np.inf)
    np.minimum.at(first, index, stamps)
    return np.asarray(np.argsort(np.argsort(first, kind="stable"), kind="stable")[index])


def runs_of(samples: Samples, wrong: np.ndarray) -> tuple[tuple[int, int], ...]:
    """Runs (first, last station, counted in order of time) of neighbours that are rejected together.

    wrong: True for rejected samples, (N,). At least three in a row, seen through one frame, in a run that as many
    rejections scattered at random would hold anywhere with a chance below 1 %. In motion neighbours share their noise:
    there half a second counts as one.
    """
    if not wrong.any():
        return ()
    number, unit = station_numbers(samples), independent_unit(samples)
    runs: set[tuple[int, int]] = set()
    for f in np.unique(samples.frame[wrong]):
        rows = np.flatnonzero(samples.frame == f)
        rank = in_order_of_time(unit[rows], samples.stamps[rows])
        count = int(rank.max()) + 1
        bad = np.bincount(rank, wrong[rows], count) > 0.5 * np.bincount(rank, minlength=count)
        for a, b in consecutive(bad):
            if b - a >= MIN_RUN and chance_of_run(b - a, int(bad.sum()), count) < CHANCE:
                inside = number[rows[(rank >= a) & (rank < b)]]
                runs.add((int(inside.min()), int(inside.max())))
    return tuple(sorted(runs))


def places_of(samples: Samples, wrong: np.ndarray) -> tuple[RejectedPlace, ...]:
    """Where neighbours by a joint's position are rejected together, whenever they were measured.

    wrong: True for rejected samples, (N,). As for :func:`runs_of`, but in the order of each joint, and the chance is
    that of all joints together. Of several joints that show the same stations the one is named that chance explains
    least. In motion neighbours in posture are neighbours in time: :func:`runs_of` has them.
    """
    if not wrong.any() or samples.moving.any():
        return ()
    unit = np.unique(samples.station, return_inverse=True)[1]
    count = int(unit.max()) + 1
    each = np.bincount(unit, minlength=count)
    bad = np.bincount(unit, wrong, count) > 0.5 * each
    found: list[tuple[float, frozenset[int], RejectedPlace]] = []
    for j, name in enumerate(samples.names):
        x = np.bincount(unit, samples.q[:, j], count) / each
        order = np.argsort(x, kind="stable")
        for a, b in consecutive(bad[order]):
            chance = chance_of_run(b - a, int(bad.sum()), count) * len(samples.names)
            if b - a >= MIN_RUN and chance < CHANCE:
                at = order[a:b]
                place = RejectedPlace(name, float(x[at].min()), float(x[at].max()), b - a)
                found.append((chance, frozenset(at.tolist()), place))
    out: list[RejectedPlace] = []
    said: set[int] = set()
    for _, stations, place in sorted(found, key=lambda one: one[0]):
        if len(stations - said) >= MIN_RUN:
            out.append(place)
            said |= stations
    return tuple(out)


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


def _log_choose(n: int, k: int) -> float:
    return lgamma(n + 1) - lgamma(k + 1) - lgamma(n - k + 1)

"""Three sets that never meet: *train* fits, *explain* chooses, *held-out* scores, once.

The unit is a station, so that readings of one dwell stay together. A recording whose neighbours in time are neighbours
in posture (a dense grid, a motion) is cut into blocks of time instead: there a random station is nearly a copy of the
one before it, and a random split would flatter. Postures that are visited again and again, or read several times
without being left, are kept together for the same reason: a model that has met a posture has its reading by heart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, lgamma

import numpy as np

from modcal_core.errors import NotEnoughData
from modcal_core.geometry import Array
from modcal_core.measurements import Samples, posture_numbers

SHARES = (0.5, 0.2, 0.3)  # *train*, *explain* and *test*: the fit needs most, the score more than the choice of effects
_MIN_DENSE = 200  # stations; fewer are posed one by one, and blocks of them would leave too few blocks
_BLOCKS, _SHORTEST, _LONGEST = 60, 5, 200  # how many blocks a recording is cut into, and stations in one
_FEW_AGAIN = 0.1  # share of stations in a posture that was met before: so few hardly flatter, and show what repeats
_FEWEST = 10  # blocks with which each set has one: a fifth is the smallest share
_DENSE = 0.25  # median step from station to station, as a fraction of the median distance between any two


@dataclass(frozen=True)
class Split:
    """Row indices of the three sets, and the unit that was kept together: "station" or "block"."""

    train: np.ndarray
    explain: np.ndarray
    held_out: np.ndarray
    unit: str

    @property
    def role(self) -> np.ndarray:
        """For each row of the samples 0, 1 or 2: whether it fits, chooses or scores, (N,)."""
        out = np.zeros(len(self.train) + len(self.explain) + len(self.held_out), int)
        out[self.explain], out[self.held_out] = 1, 2
        return out


def split(
    samples: Samples, rng: np.random.Generator, block: int | None = None, change_points: Sequence[float] = ()
) -> Split:
    """The three sets of these samples.

    block: stations in a block; 1 splits by station, None decides by how dense the recording is. change_points: rising
    times [s] at which something changed: each stretch between them has a share in each set. Raises NotEnoughData where
    the blocks are so long that a set is left without any.
    """
    first = np.unique(samples.station, return_index=True)[1]
    first = first[np.argsort(samples.stamps[first], kind="stable")]
    if block is None:
        block = block_length(samples)
    role_of_station: dict[int, int] = {}
    # Frame by frame and stretch by stretch, so that none is left without a share in each set
    part = np.searchsorted(change_points, samples.stamps[first], side="right")
    posture = _postures(samples, first)
    role_of_posture: dict[int, int] = {}
    for f, stretch in sorted(set(zip(samples.frame[first].tolist(), part.tolist(), strict=True))):
        rows = np.flatnonzero((samples.frame[first] == f) & (part == stretch))
        met = np.array([p in role_of_posture for p in posture[rows].tolist()], dtype=np.bool_)
        for row in rows[met].tolist():
            role_of_station[int(samples.station[first[row]])] = role_of_posture[int(posture[row])]
        rows = rows[~met]
        if not len(rows):
            continue
        stations = samples.station[first[rows]]
        blocks = np.unique(posture[rows], return_inverse=True)[1] // block
        order = rng.permutation(int(blocks.max()) + 1)
        sizes = np.bincount(blocks)[order]
        # a role for each block, in order, so that the shares are met as closely as the sizes allow
        role_of_block = np.empty(len(order), int)
        role_of_block[order] = np.searchsorted(np.cumsum(SHARES)[:-1], (np.cumsum(sizes) - 0.5 * sizes) / len(stations))
        role_of_station.update(zip(stations.tolist(), role_of_block[blocks].tolist(), strict=True))
        role_of_posture.update(zip(posture[rows].tolist(), role_of_block[blocks].tolist(), strict=True))
    role = np.array([role_of_station[s] for s in samples.station.tolist()])
    train, explain, held_out = (np.flatnonzero(role == r) for r in range(3))
    if block > 1 and not min(len(train), len(explain), len(held_out)):
        said = f"{len(first)} stations in blocks of {block} leave nothing to fit, to choose effects by or to hold out"
        raise NotEnoughData(f"--block {block}", said, f"give at most --block {max(1, len(first) // _FEWEST)}")
    return Split(train, explain, held_out, unit="station" if block == 1 else "block")


def distinct(q: Array) -> np.ndarray:
    """Numbers that stations (N, n) share that stand in one posture, (N,); each its own where that is an exception."""
    posture = posture_numbers(q)
    again = len(q) - len(np.unique(posture))
    return posture if again > _FEW_AGAIN * len(q) else np.arange(len(q))


def units_of_stations(samples: Samples) -> tuple[np.ndarray, np.ndarray]:
    """The numbers of all stations, rising, and for each that of what is kept together: its posture's, by time."""
    stations, first = np.unique(samples.station, return_index=True)
    order = np.argsort(samples.stamps[first], kind="stable")
    unit = np.empty(len(stations), int)
    unit[order] = np.unique(_postures(samples, first[order]), return_inverse=True)[1]
    return stations, unit


def _postures(samples: Samples, first: np.ndarray) -> np.ndarray:
    """Numbers of the postures of stations whose first rows these are, in order of time; in motion each its own."""
    return np.arange(len(first)) if samples.moving.any() else distinct(samples.q[first])


def hold_out_all(samples: Samples) -> Split:
    """Every sample held out: for scoring a model that was fitted elsewhere."""
    none = np.empty(0, int)
    return Split(none, none, np.arange(len(samples)), unit="station")


def block_length(samples: Samples) -> int:
    """Stations that must be kept together; 1 where neighbours in time are no neighbours in posture."""
    first = np.unique(samples.station, return_index=True)[1]
    first = first[np.argsort(samples.stamps[first], kind="stable")]
    q = samples.q[first][np.unique(_postures(samples, first))]
    if len(q) < _MIN_DENSE:
        return 1
    near = np.median(np.linalg.norm(np.diff(q, axis=0), axis=1))
    far = np.median(np.linalg.norm(q - np.roll(q, len(q) // 3 + 1, axis=0), axis=1))
    if near >= _DENSE * far and not samples.moving.any():
        return 1
    return int(np.clip(len(q) // _BLOCKS, _SHORTEST, _LONGEST))


# --- Stations in order of time or of a joint, and runs of them: whether neighbours were rejected together by chance

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
    number = station_numbers(samples)
    posture = posture_numbers(samples.q[np.unique(number, return_index=True)[1]])
    stop = np.cumsum(np.r_[0, np.diff(posture) != 0])[number]
    key = np.where(samples.moving, np.floor(samples.stamps / _MEMORY), stop)
    return np.unique(np.stack([samples.moving, key]), axis=1, return_inverse=True)[1].ravel()


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

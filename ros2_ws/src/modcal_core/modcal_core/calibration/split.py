"""Three sets that never meet: *train* fits, *explain* chooses, *held-out* scores, once.

The unit is a station, so that readings of one dwell stay together. A recording whose neighbours in time are neighbours
in posture (a dense grid, a motion) is cut into blocks of time instead: there a random station is nearly a copy of the
one before it, and a random split would flatter. Postures that are visited again and again, or read several times
without being left, are kept together for the same reason: a model that has met a posture has its reading by heart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.errors import NotEnoughData
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.returns import posture_numbers
from modcal_core.measurements.samples import Samples

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
        role_of_block = np.empty(len(order), int)
        role_of_block[order] = _deal(sizes, len(stations))
        role_of_station.update(zip(stations.tolist(), role_of_block[blocks].tolist(), strict=True))
        role_of_posture.update(zip(posture[rows].tolist(), role_of_block[blocks].tolist(), strict=True))
    role = np.array([role_of_station[s] for s in samples.station.tolist()])
    train, explain, held_out = (np.flatnonzero(role == r) for r in range(3))
    if block > 1 and not min(len(train), len(explain), len(held_out)):
        raise NotEnoughData(
            f"--block {block}",
            f"{len(first)} stations in blocks of {block} leave nothing to fit, to choose effects by or to hold out",
            f"give at most --block {max(1, len(first) // _FEWEST)}",
        )
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


def _deal(sizes: np.ndarray, total: int) -> np.ndarray:
    """A role for each block, in order, so that the shares are met as closely as the sizes allow."""
    centre = (np.cumsum(sizes) - 0.5 * sizes) / total
    return np.searchsorted(np.cumsum(SHARES)[:-1], centre)


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

"""Readings that stand beside another posture than their own: parts that slipped, rows in another order, wrong labels.

Where most readings stand in their own row, they tell base and tool, and each of the rest is compared with the pose that
the arm had at every other station. Where few do, orders that tables get into are compared as wholes: a coordinate of a
point of the tool is linear in the turn and the place of the arm's tip, so that its variance is mostly explained in the
true order and in hardly any other.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from modcal_core.calibration import consecutive
from modcal_core.geometry import Array, se3
from modcal_core.measurements import Samples
from modcal_core.plausibility.agreement import Disagreement, limits
from modcal_core.plausibility.consensus import placed_by_most
from modcal_core.plausibility.most_seen import most_seen
from modcal_core.robots import Chain, Mechanism, forward, is_serial_arm

_MIN = 24  # stations
_MAX = 400  # the same at most, the first ones: rows that are left out would hide where the others belong
_MIN_SHARE = 0.2  # of the stations that must agree on a base and a tool
_FEWEST = 6  # readings that stand elsewhere
_EXPLAINED = 0.8  # share of the rest that must belong to another posture
_LEFT = 0.6  # of the variance, below which another order is looked at; by chance nine tenths are left
_NEAR = 2.0  # times what a nominal arm misses by; base and tool may be from a few stations
_APART = 3.0  # times the distance that counts as the same, by which neighbouring postures must be apart
_ALIKE = 0.9  # share of readings that moved alike, from which that is said of all


def mispaired(samples: Samples, chain: Mechanism) -> Disagreement | None:
    """How readings stand beside other postures than their own, None where that does not explain them.

    samples: all of them; in a frame of several, that with most readings is looked at.
    """
    part = most_seen(samples, chain, _MIN, _MAX)
    if part is None or not is_serial_arm(chain):
        return None
    try:
        for said, order in _orders(part, chain):
            found = _in_order(part, chain, said, order)
            if found is not None:
                return found
    except np.linalg.LinAlgError:  # postures that do not tell base and tool at all
        return None
    return None


def _orders(samples: Samples, chain: Chain) -> Iterator[tuple[str, np.ndarray]]:
    """The order as it is, and the most likely of others: what to say of it, and the posture of each reading (N,)."""
    N = len(samples)
    yield "", np.arange(N)
    orders = [("stand in reverse order", np.arange(N)[::-1])]
    by_name = np.array(sorted(range(N), key=lambda k: str(k + 1)))
    orders.append(("stand in the order of file names (1, 10, 100, …)", by_name))
    orders.append(("were put in the order of file names (1, 10, 100, …)", np.argsort(by_name)))
    for shift in range(1, N):
        orders.append((_slipped(shift, N), (np.arange(N) + shift) % N))
    A = forward(chain, samples.q)
    design = np.concatenate([A[:, :3, :3].reshape(N, 9), A[:, :3, 3]], axis=1)
    U, size, _ = np.linalg.svd(design - design.mean(axis=0), full_matrices=False)
    U = U[:, size > 1e-6 * size[0]]
    p = samples.reading - samples.reading.mean(axis=0)
    whole = float(np.sum(p**2))
    left = [1.0 - float(np.sum((U[order].T @ p) ** 2)) / whole for _, order in orders]
    best = int(np.argmin(left))
    if left[best] < _LEFT:
        yield orders[best]


def _slipped(shift: int, of: int) -> str:
    """Refusal of readings that belong to the posture ``shift`` rows later, or ``of - shift`` earlier."""
    if min(shift, of - shift) > 0.2 * of:
        return f"stand in two parts that are exchanged: the first row's belongs to row {shift + 1}"
    if 2 * shift < of:
        return f"look early by {shift} stations: each stands {shift} rows too high"
    return f"look late by {of - shift} stations: each stands {of - shift} rows too low"


def _in_order(samples: Samples, chain: Chain, said: str, order: np.ndarray) -> Disagreement | None:
    """Whether most readings agree in this order, and where the rest belongs."""
    N = len(samples)
    moved = replace(samples, q=samples.q[order])
    placed, agree = placed_by_most(moved, chain)
    if placed is None or agree.sum() < max(_MIN // 2, _MIN_SHARE * N):
        return None
    A = forward(chain, samples.q)
    turns, places = placed.Y @ A[:, :3, :3] @ placed.X, se3.apply(A, placed.x) @ placed.Y.T + placed.t
    limit = limits(chain)
    turned, missed = placed.residual(A[order], moved)
    here = (turned < _NEAR * limit[0]) & (missed < _NEAR * limit[1])
    if said:
        if here.mean() < _EXPLAINED:
            return None
        return _said(samples, here, f"readings {said}, and agree with the arm in that order")
    rest = np.flatnonzero(~here)
    gap = np.linalg.norm(samples.reading[rest, None] - places, axis=2)
    if _too_close(places, turns, samples, limit):
        return None
    same = gap < _NEAR * limit[1]
    if samples.is_pose.all():
        cosine = 0.5 * (np.einsum("nij,kij->nk", samples.R[rest], turns) - 1.0)
        same &= cosine > np.cos(_NEAR * limit[0])
    found = same.any(axis=1)
    if found.sum() < _FEWEST or found.mean() < _EXPLAINED:
        return None
    return _of_rest(samples, rest[found], same[found], gap[found])


def _too_close(places: Array, turns: Array, samples: Samples, limit: tuple[float, float]) -> bool:
    """Whether neighbours in order are so near that a reading that is a little off belongs to them as well."""
    gap = np.linalg.norm(np.diff(places, axis=0), axis=1) / limit[1]
    if samples.is_pose.all():
        cosine = 0.5 * (np.einsum("nij,nij->n", turns[1:], turns[:-1]) - 1.0)
        gap = np.maximum(gap, np.arccos(np.clip(cosine, -1.0, 1.0)) / limit[0])
    return bool(np.median(gap) < _NEAR * _APART)


def _of_rest(samples: Samples, rows: np.ndarray, same: np.ndarray, gap: Array) -> Disagreement:
    """Refusal of readings that belong to other postures. same, gap: of each reading to every posture, (rows, N)."""
    offsets = Counter(int(k - i) for i, row in zip(rows, same, strict=True) for k in np.flatnonzero(row))
    offset, count = offsets.most_common(1)[0]
    concerned = np.zeros(len(samples), bool)
    concerned[rows] = True
    where = f"at {_stations(samples, concerned)}"
    if count >= _ALIKE * len(rows):
        far = f"{abs(offset)} station{'s' if abs(offset) > 1 else ''}"
        how = f"readings {where} look {'early' if offset > 0 else 'late'} by {far}"
        how += f": each stands {abs(offset)} row{'s' if abs(offset) > 1 else ''} too {'high' if offset > 0 else 'low'}"
        return _said(samples, ~concerned, f"{how}, or joint states the other way")
    sums = Counter(int(k + i) for i, row in zip(rows, same, strict=True) for k in np.flatnonzero(row))
    if sums.most_common(1)[0][1] >= _ALIKE * len(rows):
        return _said(samples, ~concerned, f"readings {where} stand in reverse order of the rows")
    belongs = np.argmin(np.where(same, gap, np.inf), axis=1)
    mutual = np.mean([k in rows and belongs[np.searchsorted(rows, k)] == i for i, k in zip(rows, belongs, strict=True)])
    number = samples.station
    first = f"that at station {number[rows[0]]} to station {number[belongs[0]]}"
    if mutual > _EXPLAINED:
        return _said(samples, ~concerned, f"rows of readings {where} look swapped two and two ({first})")
    return _said(samples, ~concerned, f"readings {where} belong to other stations, in another order of rows ({first})")


def _stations(samples: Samples, concerned: np.ndarray) -> str:
    runs, number = consecutive(concerned), samples.station
    if len(runs) <= 3:
        return "stations " + " and ".join(f"{number[a]} to {number[b - 1]}" for a, b in runs)
    return f"{int(concerned.sum())} of {len(concerned)} stations"


def _said(samples: Samples, right: np.ndarray, what: str) -> Disagreement:
    remedy = "pair each reading with its own posture (a table that slipped or was sorted, labels, or a clock)"
    return Disagreement(what, remedy, int(len(right) if right.all() else (~right).sum()), len(samples))

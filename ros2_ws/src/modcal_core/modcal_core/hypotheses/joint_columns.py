"""Which columns of a table are the joints of an arm, and in which order, told by what they explain of the readings.

A coordinate of a point of the tool is linear in the nine elements of the tip's turn, its place and 1, whatever base and
tool are, in any unit; and so it is of the tracker's place in the tool, with the inverse of the tip's pose. So an order
of the columns has a residual without anything else being known, and thousands of orders are compared at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations
from math import factorial, perm

import numpy as np

from modcal_core.geometry import Array
from modcal_core.measurements import spread_rows
from modcal_core.robots import Chain, forward

MIN_ROWS = 26  # half of what is seen is fitted; with fewer rows chance explains too much
_ROWS = 40  # evenly along the table; a coordinate has 13 coefficients
_MAX_ORDERS = 45_000  # that are compared: all of seven columns out of eight
_AT_ONCE = 256  # orders in a block, for memory
_SWAPPED = 3  # of the best, around which orders are looked at where there are too many for all
_EXPLAINED = 2e-3  # share of the variance; right columns leave a hundredth of it, wrong ones a hundred times as much


@dataclass(frozen=True)
class Order:
    """Columns of the joints, the triple of coordinates that they explain best, and the share of it that is left."""

    columns: tuple[int, ...]
    triple: int
    left: float

    @property
    def explains(self) -> bool:
        """Whether so little is left that it is no chance."""
        return self.left < _EXPLAINED


def likely_orders(
    chain: Chain, values: Array, scale: float, pool: Sequence[int], triples: Sequence[tuple[int, int, int]], count: int
) -> list[Order]:
    """The likeliest choices of joints' columns, best first.

    values: all columns (N, W); scale: of the joints' columns to rad, m; pool: columns that may be joints, in their
    order; triples: columns that may be a position, in any unit. Empty where there are too few rows or columns.
    """
    N, M = len(values), len(pool)
    if N < MIN_ROWS or chain.n > M or not triples:
        return []
    rows = spread_rows(N, _ROWS)
    search = _ColumnSearch(chain, scale * values[rows], values[rows], triples)
    windows = [tuple(pool[first : first + chain.n]) for first in range(M - chain.n + 1)]
    found = search.all(windows)
    if not any(order.explains for order in found):
        every = perm(M, chain.n) <= _MAX_ORDERS
        if every or factorial(chain.n) * len(windows) <= _MAX_ORDERS:
            more = list(permutations(pool, chain.n)) if every else [o for w in windows for o in permutations(w)]
            found += search.all(more)
        found = _improved(search, found, pool)
    best = {order.columns: order for order in sorted(found, key=lambda order: order.left)}
    return list(best.values())[:count]


def _improved(search: _ColumnSearch, found: list[Order], pool: Sequence[int]) -> list[Order]:
    """Orders found by exchanging two joints, or one for a column that is not used, as long as that helps."""
    known = {order.columns: order for order in found}
    while True:
        top = sorted(known.values(), key=lambda order: order.left)[:_SWAPPED]
        if not top or top[0].explains:  # none: every choice would take the readings' own columns
            return list(known.values())
        new = dict.fromkeys(o for order in top for o in _neighbours(order.columns, pool) if o not in known)
        known |= {order.columns: order for order in search.all(list(new))}
        if not new or min(order.left for order in known.values()) >= top[0].left * (1.0 - 1e-9):
            return list(known.values())


def _neighbours(order: tuple[int, ...], pool: Sequence[int]) -> Iterator[tuple[int, ...]]:
    for i, j in combinations(range(len(order)), 2):
        new = list(order)
        new[i], new[j] = new[j], new[i]
        yield tuple(new)
    for i in range(len(order)):
        for other in sorted(set(pool) - set(order)):
            yield (*order[:i], other, *order[i + 1 :])


@dataclass(frozen=True)
class _ColumnSearch:
    """q: all columns as joints (N, W) [rad, m]. values: the same as coordinates."""

    chain: Chain
    q: Array
    values: Array
    triples: Sequence[tuple[int, int, int]]

    def all(self, orders: Sequence[tuple[int, ...]]) -> list[Order]:
        """These orders, with what they leave."""
        columns = sorted({k for triple in self.triples for k in triple})
        place = {k: i for i, k in enumerate(columns)}
        at = np.array([[place[k] for k in triple] for triple in self.triples])
        centred = self.values[:, columns] - self.values[:, columns].mean(axis=0)
        whole = np.maximum(np.sum(centred**2, axis=0), 1e-300)
        own = np.array([[len(set(order) & set(triple)) > 0 for triple in self.triples] for order in orders])
        out: list[Order] = []
        for first in range(0, len(orders), _AT_ONCE):
            some = np.array(orders[first : first + _AT_ONCE])
            A = forward(self.chain, self.q[:, some].swapaxes(0, 1).reshape(-1, self.chain.n))
            A = A.reshape(len(some), len(self.q), 4, 4)
            R, t = A[..., :3, :3], A[..., :3, 3]
            back = np.swapaxes(R, -1, -2)
            each = unexplained(R, t, centred, whole), unexplained(back, (back @ t[..., None])[..., 0], centred, whole)
            left = np.minimum(*(share[:, at].mean(axis=2) for share in each))
            left[own[first : first + len(some)]] = np.inf
            best = left.argmin(axis=1)
            out += [
                Order(tuple(int(k) for k in order), int(b), float(share[b]))
                for order, b, share in zip(some, best, left, strict=True)
                if np.isfinite(share[b])
            ]
        return out


def unexplained(R: Array, t: Array, centred: Array, whole: Array | float = 1.0) -> Array:
    """Share of the squares of coordinates (N, K) that turns (C, N, 3, 3) and places (C, N, 3) leave, (C, K)."""
    design = np.concatenate([R.reshape(*R.shape[:2], 9), t], axis=2)
    design = design - design.mean(axis=1, keepdims=True)
    H = np.swapaxes(design, 1, 2) @ design
    g = np.swapaxes(design, 1, 2) @ centred
    held = 1e-9 * np.trace(H, axis1=1, axis2=2)[:, None, None] * np.eye(12)
    return np.asarray((np.sum(centred**2, axis=0) - np.sum(g * np.linalg.solve(H + held, g), axis=1)) / whole)

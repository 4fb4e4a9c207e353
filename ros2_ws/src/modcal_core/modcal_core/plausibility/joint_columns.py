"""Which columns of a table are the joints of an arm, and in which order, told by what they explain of the readings.

A coordinate of a point of the tool is linear in the nine elements of the tip's turn, its place and 1, whatever base and
tool are, in any unit; and so it is of the tracker's place in the tool, with the inverse of the tip's pose. So an order
of the columns has a residual without anything else being known, and thousands of orders are compared at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, permutations
from math import comb, factorial, perm

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.mechanism import forward

_ROWS = 48  # evenly along the table; a coordinate has 13 coefficients
LEAST_ROWS = 26  # half of what is seen is fitted; with fewer rows chance explains too much
MOST_ORDERS = 30_240  # that are compared: all of five columns out of ten
_AT_ONCE = 512  # orders in a block, for memory
_SWAPPED = 4  # of the best, around which orders are looked at where there are too many for all


def likely_orders(chain: Chain, columns: Array, position: Array, count: int) -> list[tuple[int, ...]]:
    """The likeliest choices of joints' columns, best first.

    columns: candidates (N, M) [rad, m]. position: three columns of the readings (N, 3) in any unit. Empty where there
    are too few rows or columns.
    """
    N, M = columns.shape
    if N < LEAST_ROWS or chain.n > M:
        return []
    rows = np.unique(np.linspace(0, N - 1, min(N, _ROWS)).astype(int))
    q, p = columns[rows], position[rows]
    if perm(M, chain.n) <= MOST_ORDERS:
        orders = np.array(list(permutations(range(M), chain.n)))
        return _best(orders, _missed(chain, q, p, orders), count)
    start = np.array(list(_in_order(M, chain.n)))
    best = _best(start, _missed(chain, q, p, start), _SWAPPED)
    seen = {order: float(miss) for order, miss in zip(best, _missed(chain, q, p, np.array(best)), strict=True)}
    while True:  # steepest descent by exchanging two joints, or one for a column that is not used
        top = sorted(seen, key=lambda order: seen[order])[:_SWAPPED]
        new = [o for order in top for o in _neighbours(order, M) if o not in seen]
        if not new:
            break
        before = seen[top[0]]
        seen |= dict(zip(new, _missed(chain, q, p, np.array(new)).tolist(), strict=True))
        if min(seen.values()) >= before * (1.0 - 1e-9):
            break
    return sorted(seen, key=lambda order: seen[order])[:count]


def _in_order(M: int, n: int) -> Iterator[tuple[int, ...]]:
    """Columns in the table's order; all orders of neighbours where these are few enough."""
    if factorial(n) * (M - n + 1) <= MOST_ORDERS:
        for first in range(M - n + 1):
            yield from permutations(range(first, first + n))
    if comb(M, n) <= MOST_ORDERS:
        yield from combinations(range(M), n)
    else:
        yield from (tuple(range(first, first + n)) for first in range(M - n + 1))


def _neighbours(order: tuple[int, ...], M: int) -> Iterator[tuple[int, ...]]:
    for i, j in combinations(range(len(order)), 2):
        new = list(order)
        new[i], new[j] = new[j], new[i]
        yield tuple(new)
    for i in range(len(order)):
        for other in set(range(M)) - set(order):
            yield (*order[:i], other, *order[i + 1 :])


def _best(orders: Array, missed: Array, count: int) -> list[tuple[int, ...]]:
    return [tuple(int(i) for i in orders[k]) for k in np.argsort(missed, kind="stable")[:count]]


def _missed(chain: Chain, q: Array, p: Array, orders: Sequence[Sequence[int]] | Array) -> Array:
    """Share of the coordinates' variance that each order leaves, of the pose or of its inverse, the smaller one."""
    orders = np.asarray(orders)
    centred = p - p.mean(axis=0)
    whole = np.maximum(np.sum(centred**2, axis=0), 1e-300)
    out = np.empty(len(orders))
    for first in range(0, len(orders), _AT_ONCE):
        some = orders[first : first + _AT_ONCE]
        A = forward(chain, q[:, some].swapaxes(0, 1).reshape(-1, chain.n)).reshape(len(some), len(q), 4, 4)
        R, t = A[..., :3, :3], A[..., :3, 3]
        back = np.swapaxes(R, -1, -2)
        each = [_left(R, t, centred, whole), _left(back, (back @ t[..., None])[..., 0], centred, whole)]
        out[first : first + len(some)] = np.minimum(*each)
    return out


def _left(R: Array, t: Array, centred: Array, whole: Array) -> Array:
    """Share of the variance of the coordinates (N, 3) that is left, for turns (C, N, 3, 3) and places (C, N, 3)."""
    design = np.concatenate([R.reshape(*R.shape[:2], 9), t], axis=2)
    design = design - design.mean(axis=1, keepdims=True)
    H = np.swapaxes(design, 1, 2) @ design
    g = np.swapaxes(design, 1, 2) @ centred
    held = 1e-9 * np.trace(H, axis1=1, axis2=2)[:, None, None] * np.eye(12)
    explained = np.sum(g * np.linalg.solve(H + held, g), axis=1)
    return np.asarray(np.mean(1.0 - explained / whole, axis=1))

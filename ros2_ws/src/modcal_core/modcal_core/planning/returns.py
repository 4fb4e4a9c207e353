"""Which stations of a tour are visited a second time, and when: what the arm does not repeat is seen only there.

A return is left in between and come back to from another side: as many joints as possible arrive in the other
direction than the first time, so that backlash is part of what is seen. Returns are spread over the whole tour, and
the time between the two visits is short for every other one and long for the rest, so that a slow drift, which grows
with that time, is told from scatter, which does not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.measurements.approach import TRAVEL

RETURNS = 6  # the fewest from which a verdict takes a floor
_STATIONS_EACH = 3  # a tour of fewer stations to a return is too short to leave each posture in between
_CHOICES = 10  # stops earlier or later that a visit may lie, in search of other sides to come from
_SHORT, _LONG = 0.1, 0.75  # of the tour up to the second visit, from the first one to it

Passable = Callable[[Array, Array], bool]


@dataclass(frozen=True)
class Tour:
    """order: of the stops, numbers of stations, (k + r,). pairs: (first, second) stop of each return, by number."""

    order: np.ndarray
    pairs: tuple[tuple[int, int], ...]


def with_returns(q: Array, count: int = RETURNS, passable: Passable | None = None) -> Tour:
    """A tour through stations q (k, n), in their order, that comes back to ``count`` of them.

    There are none where fewer than three stations are there to each return. passable: whether the arm may go straight
    from one posture (n,) to another; None: always.
    """
    k = len(q)
    if count < 1 or k < _STATIONS_EACH * count or k < 3:
        return Tour(np.arange(k), ())
    came = _sides(np.vstack([q[:1], q[:-1]]), q)  # from where the first one is reached is not known: it is left out
    half = min(max(1, k // (4 * count)), _CHOICES)
    after: dict[int, int] = {}
    for r in range(count):
        last = (r + 1) * k // count - 1  # the stop after which the return comes
        wanted = (_LONG if r % 2 else _SHORT) * last
        found = [
            _best(q, came, m, wanted, after, passable) for m in range(max(last - half, 2), min(last + half, k - 1) + 1)
        ]
        if choices := [choice for choice in found if choice is not None]:
            _, m, i = max(choices)
            after[m] = i
            if m + 1 < k:
                came[m + 1] = _sides(q[i], q[m + 1])
    order = [s for m in range(k) for s in ((m, after[m]) if m in after else (m,))]
    first: dict[int, int] = {}
    pairs = [(first[s], at) for at, s in enumerate(order) if first.setdefault(s, at) < at]
    return Tour(np.array(order), tuple(pairs))


def _sides(before: Array, here: Array) -> Array:
    """From which side each joint comes, −1, 0 or 1, (m, n)."""
    way = here - before
    return np.where(np.abs(way) > TRAVEL, np.sign(way), 0.0)


def _best(
    q: Array, came: Array, m: int, wanted: float, after: dict[int, int], passable: Passable | None
) -> tuple[float, int, int] | None:
    """(worth, m, i) of the best station i to visit again after station m; None where there is none.

    Worth is the share of joints that come from the other side, less what the time since the first visit is off the one
    that is wanted, as a share of the tour so far.
    """
    if m in after or m + 1 in after.values():
        return None  # a first visit keeps the side that it was reached from
    i = np.setdiff1d(np.arange(m - 1), list(after.values()))
    other = np.mean(_sides(q[m], q[i]) * came[i] < 0.0, axis=1)
    worth = np.where(other > 0.0, other - np.abs(m - i - wanted) / m, -np.inf)
    for at in np.argsort(-worth, kind="stable"):
        if not np.isfinite(worth[at]):
            break
        if _open(q, m, int(i[at]), passable):
            return float(worth[at]), m, int(i[at])
    return None


def _open(q: Array, m: int, i: int, passable: Passable | None) -> bool:
    """Whether station i can be visited between stations m and m + 1."""
    if passable is None:
        return True
    return passable(q[m], q[i]) and (m + 1 >= len(q) or passable(q[i], q[m + 1]))

"""The order in which stations are visited, and the way between them, in the joints' space.

A return is left in between and come back to from another side, so that backlash is part of what is seen. Returns are
spread over the whole tour, and every other one is short, so that slow drift is told from scatter, which does not grow.

Ways are straight. Where one would touch something, a way over other allowed postures is looked for: a roadmap whose
edges are checked only when a shortest way wants to use them (lazy PRM; Bohlin & Kavraki 2000), at steps of 0.02 rad.
That does not take the place of a motion planner.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from modcal_core.geometry import Array
from modcal_core.measurements import TRAVEL

_STEP = 0.02  # rad or m between two postures of a way that are checked
_NEIGHBOURS = 20  # nearest postures of a roadmap that a way may lead to
_TRIED = 200  # ways over the roadmap before one is given up
_PERIOD = 0.1  # s between two points of a trajectory
_PEAK = 1.875  # of the mean speed: the fastest moment of a smooth step (a quintic)

Free = Callable[[Array], np.ndarray]


def is_free(a: Array, b: Array, free: Free) -> bool:
    """Whether the straight way between two postures (n,) is free, both ends included."""
    count = max(int(np.ceil(np.abs(b - a).max() / _STEP)), 1)
    # ends and middle first: what is not free is mostly seen there
    share = np.linspace(0.0, 1.0, count + 1)
    coarse = np.r_[share[:: max(count // 8, 1)], 1.0]
    return all(bool(free(a + np.multiply.outer(some, b - a)).all()) for some in (coarse, share))


class Roadmap:
    """Allowed postures (N, n), and the ways between near ones, each free until it has been looked at.

    free: says of postures (N, n) which are allowed. It is drawn when the first straight way is not free.
    """

    def __init__(self, q: Array, free: Free) -> None:
        self._q, self._free, self._open = q, free, np.zeros(0, bool)

    def _draw(self) -> None:
        from scipy.spatial import cKDTree

        q = self._q
        near = cKDTree(q).query(q, k=min(_NEIGHBOURS + 1, len(q)), p=np.inf)[1].reshape(len(q), -1)
        ends = np.stack([np.repeat(np.arange(len(q)), near.shape[1]), near.ravel()], axis=1)
        self._edges = np.unique(np.sort(ends[ends[:, 0] != ends[:, 1]], axis=1), axis=0)
        self._length = np.abs(q[self._edges[:, 0]] - q[self._edges[:, 1]]).max(axis=1)
        self._number = {(int(a), int(b)): i for i, (a, b) in enumerate(self._edges)}
        self._open = np.ones(len(self._edges), dtype=bool)
        self._looked_at = np.zeros(len(self._edges), dtype=bool)

    def way(self, a: int, b: int) -> Array | None:
        """Postures between two of the map, (m, n): none where the straight way is free; None if no way is."""
        if is_free(self._q[a], self._q[b], self._free):
            return self._q[:0]
        if not len(self._open):
            self._draw()
        for _ in range(_TRIED):
            path = self._shortest(a, b)
            if path is None or self._free_all_along(path):
                return None if path is None else self._q[path[1:-1]]
        return None

    def _free_all_along(self, path: list[int]) -> bool:
        """Whether every way on a path is free; the first one that is not is closed."""
        for i, j in pairwise(path):
            k = self._number[min(i, j), max(i, j)]
            if not self._looked_at[k]:
                self._looked_at[k] = True
                self._open[k] = is_free(self._q[i], self._q[j], self._free)
            if not self._open[k]:
                return False
        return True

    def _shortest(self, a: int, b: int) -> list[int] | None:
        from scipy.sparse import csr_matrix
        from scipy.sparse.csgraph import dijkstra

        graph = csr_matrix((self._length[self._open], self._edges[self._open].T), shape=(len(self._q),) * 2)
        length, before = dijkstra(graph, directed=False, indices=np.array(a), return_predecessors=True)
        if not np.isfinite(length[b]):
            return None
        path = [b]
        while path[-1] != a:
            path.append(int(before[path[-1]]))
        return path[::-1]


def free_way(start: Array, goal: Array, free: Free, over: Array) -> list[Array] | None:
    """Postures from the start to the goal (n,), straight ways between them being free; None if none is found.

    over: free postures (m, n) that the way may lead over where it cannot be straight.
    """
    between = Roadmap(np.vstack([start, goal, over]), free).way(0, 1)
    return None if between is None else [start, *between, goal]


def from_side(goal: Array, approach: Array, amount: float = 0.05) -> Array:
    """A posture (n,) from which each joint goes to the goal in the wanted way: −1, 0 (any) or 1, (n,)."""
    return np.asarray(goal - amount * approach)


@dataclass(frozen=True)
class TimedMotion:
    """t: [s] from its beginning, rising, (k,). q, v: postures and joint speeds there, (k, n); at rest at its end."""

    t: Array
    q: Array
    v: Array

    @property
    def end(self) -> Array:
        """Where it ends, (n,)."""
        return np.asarray(self.q[-1])

    def at(self, t: float) -> Array:
        """Joint positions (n,) at a time [s] after the start."""
        return np.array([np.interp(t, self.t, column) for column in self.q.T])


def timed(way: list[Array], speed: Array) -> TimedMotion:
    """The motion along these postures, at rest at each, no joint faster than its speed (n,) [rad/s, m/s]."""
    t, q, v = [0.0], [way[0]], [np.zeros_like(way[0])]
    for a, b in pairwise(way):
        duration = max(_PEAK * float(np.max(np.abs(b - a) / speed)), 2.0 * _PERIOD)
        count = int(np.ceil(duration / _PERIOD))
        begin = t[-1]
        for k in range(1, count + 1):
            u = k / count
            t.append(begin + u * duration)
            q.append(a + (b - a) * (10.0 * u**3 - 15.0 * u**4 + 6.0 * u**5))
            v.append((b - a) * 30.0 * u**2 * (1.0 - u) ** 2 / duration)
    return TimedMotion(np.array(t), np.array(q), np.array(v))


# --- Which stations of a tour are visited a second time, and when: what the arm does not repeat is seen only there

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
        to = int(i[at])
        if passable is None or (passable(q[m], q[to]) and (m + 1 >= len(q) or passable(q[to], q[m + 1]))):
            return float(worth[at]), m, to
    return None


_ROUNDS = 20  # iterations


@dataclass(frozen=True)
class Route:
    """order: of the stations, (k,), those visited twice twice. ways: for each of the k − 1 ways the postures in
    between, (m, n), mostly none. blocked: the ways, by number, for which nothing was found. returns: (first, second)
    stop of each station that is visited twice, by number.
    """

    order: np.ndarray
    ways: tuple[Array, ...]
    blocked: tuple[int, ...]
    returns: tuple[tuple[int, int], ...] = ()

    def stops(self, q: Array) -> list[Array]:
        """For each way all its postures, from station to station, (2 + m, n). q: the stations in order, (k, n)."""
        return [np.concatenate([a[None], way, b[None]]) for a, b, way in zip(q, q[1:], self.ways, strict=False)]

    def length(self, q: Array) -> float:
        """How far the joint that moves most has to go in all [rad or m]. q: the stations in order, (k, n)."""
        return float(sum(np.abs(np.diff(stop, axis=0)).max(axis=1).sum() for stop in self.stops(q)))


def route(q: Array, free: Free, between: Array, start: Array | None = None, returns: int = 0) -> Route:
    """A short way through stations q (k, n), from the one nearest to start, that comes back to some of them.

    free: says of postures (N, n) which are allowed, (N,). between: allowed postures that ways may lead over, (N, n).
    """
    order = _shortened(q, nearest_order(q, q[0] if start is None else start))
    tour = with_returns(q[order], returns)
    order = order[tour.order]
    roadmap = Roadmap(np.concatenate([q[order], between]), free)
    ways, blocked = [], []
    for i in range(len(order) - 1):
        way = roadmap.way(i, i + 1)
        if way is None:
            blocked.append(i)
        ways.append(q[:0] if way is None else way)
    return Route(order, tuple(ways), tuple(blocked), tour.pairs)


def nearest_order(q: Array, begin: Array) -> np.ndarray:
    """Numbers of postures q (k, n), each the nearest to the one before it, the first to a posture ``begin`` (n,)."""
    left, order, here = set(range(len(q))), [], begin
    while left:
        rest = np.array(sorted(left))
        order.append(int(rest[np.argmin(np.abs(q[rest] - here).max(axis=1))]))
        left.discard(order[-1])
        here = q[order[-1]]
    return np.array(order)


def _shortened(q: Array, order: np.ndarray) -> np.ndarray:
    """The order with stretches turned round as long as that makes it shorter (2-opt); its first station stays."""
    D = np.abs(q[:, None] - q[None]).max(axis=2)
    k = len(order)
    for _ in range(_ROUNDS):
        gained = False
        for i in range(1, k - 1):
            j = np.arange(i + 1, k)
            before, here, there = order[i - 1], order[i], order[j]
            last = j == k - 1
            after = order[np.minimum(j + 1, k - 1)]
            saved = D[before, here] - D[before, there] + np.where(last, 0.0, D[there, after] - D[here, after])
            best = int(np.argmax(saved))
            if saved[best] > 1e-9:
                order[i : j[best] + 1] = order[i : j[best] + 1][::-1].copy()
                gained = True
        if not gained:
            break
    return order

"""The order in which stations are visited, and the way between them, in the joints' space.

A return is come back to from another side, so that backlash is part of what is seen. Returns are spread over the whole
tour, and every other one is short, so that slow drift is told from scatter, which does not grow.

Ways are straight. Where one would touch something, a way over other allowed postures is looked for: a roadmap whose
edges are checked only when a shortest way wants to use them (lazy PRM; Bohlin & Kavraki 2000).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from modcal_core.geometry import Array
from modcal_core.measurements import directions

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
    """Allowed postures (N, n), and the ways between near ones, each free until ``free`` has said of it what is
    allowed. It is drawn when the first straight way is not free.
    """

    def __init__(self, q: Array, free: Free) -> None:
        self._q, self._free, self._looked_at = q, free, set[tuple[int, int]]()

    @cached_property
    def _lengths(self) -> Any:
        """Lengths of the ways (N, N), sparse; infinite where one is closed."""
        from scipy.sparse import csr_matrix
        from scipy.spatial import cKDTree

        count = len(self._q)
        found = cKDTree(self._q).query(self._q, k=min(_NEIGHBOURS + 1, count), p=np.inf)
        length, near = (np.asarray(part) for part in found)
        begin = np.repeat(np.arange(count), near.shape[1])
        graph = csr_matrix((length.ravel(), (begin, near.ravel())), shape=(count, count))
        return graph.maximum(graph.T).tocsr()

    def way(self, a: int, b: int) -> Array | None:
        """Postures between two of the map, (m, n): none where the straight way is free; None if no way is."""
        from scipy.sparse.csgraph import dijkstra

        if is_free(self._q[a], self._q[b], self._free):
            return self._q[:0]
        for _ in range(_TRIED):
            reached = dijkstra(self._lengths, directed=False, indices=np.array(a), return_predecessors=True)
            length, before = reached
            if not np.isfinite(length[b]):
                return None
            path = [b]
            while path[-1] != a:
                path.append(int(before[path[-1]]))
            if all(self._is_open(i, j) for i, j in pairwise(path[::-1])):
                return self._q[path[-2:0:-1]]
        return None

    def _is_open(self, i: int, j: int) -> bool:
        """Whether a way is free; one that is not is closed for good."""
        pair = min(i, j), max(i, j)
        if pair not in self._looked_at:
            self._looked_at.add(pair)
            if not is_free(self._q[i], self._q[j], self._free):
                self._lengths[i, j] = self._lengths[j, i] = np.inf
        return bool(np.isfinite(self._lengths[i, j]))


def free_way(start: Array, goal: Array, free: Free, over: Array) -> list[Array] | None:
    """Postures from the start to the goal (n,), straight ways between them being free; None if none is found. over:
    free postures (m, n) that the way may lead over where it cannot be straight.
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
    t, q, v = [np.zeros(1)], [way[0][None]], [np.zeros((1, len(way[0])))]
    for a, b in pairwise(way):
        duration = max(_PEAK * float(np.max(np.abs(b - a) / speed)), 2.0 * _PERIOD)
        count = int(np.ceil(duration / _PERIOD))
        u = np.arange(1, count + 1) / count
        t.append(t[-1][-1] + u * duration)
        q.append(a + np.outer(10.0 * u**3 - 15.0 * u**4 + 6.0 * u**5, b - a))
        v.append(np.outer(30.0 * u**2 * (1.0 - u) ** 2 / duration, b - a))
    return TimedMotion(np.concatenate(t), np.concatenate(q), np.concatenate(v))


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
    """A tour through stations q (k, n), in their order, that comes back to ``count`` of them; to none where fewer than
    three are there to each return. passable: whether the arm may go straight from one posture (n,) to another.
    """
    k = len(q)
    if count < 1 or k < max(_STATIONS_EACH * count, 3):
        return Tour(np.arange(k), ())
    came = directions(
        np.diff(q, axis=0, prepend=q[:1])
    )  # from where the first one is reached is not known: it is left out
    half = min(max(1, k // (4 * count)), _CHOICES)
    after: dict[int, int] = {}  # the station that is visited again after a stop
    for r in range(count):
        last = (r + 1) * k // count - 1  # the stop after which the return comes
        wanted = (_LONG if r % 2 else _SHORT) * last
        choices: list[tuple[float, int, int]] = []
        for m in range(max(last - half, 2), min(last + half, k - 1) + 1):
            if m not in after and m + 1 not in after.values():  # a first visit keeps the side it was reached from
                i = np.setdiff1d(np.arange(m - 1), list(after.values()))
                other = np.mean(directions(q[i] - q[m]) * came[i] < 0.0, axis=1)
                # the share of joints that come from the other side, less what the time in between is off
                worth = other - np.abs(m - i - wanted) / m
                choices += [(float(worth[j]), m, -int(i[j])) for j in np.flatnonzero(other > 0.0)]
        for _, m, minus in sorted(choices, reverse=True):
            here = q[-minus]
            if passable is None or (passable(q[m], here) and (m + 1 >= k or passable(here, q[m + 1]))):
                after[m] = -minus
                came[m + 1 : m + 2] = directions(q[m + 1 : m + 2] - here)
                break
    order = [s for m in range(k) for s in ((m, after[m]) if m in after else (m,))]
    first: dict[int, int] = {}
    pairs = [(first[s], at) for at, s in enumerate(order) if first.setdefault(s, at) < at]
    return Tour(np.array(order), tuple(pairs))


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


def route(q: Array, free: Free, between: Array, start: Array | None = None, returns: int = 0) -> Route:
    """A short way through stations q (k, n), from the one nearest to start, that comes back to some of them, over such
    postures ``between`` (N, n) as are needed. free: says of postures (N, n) which are allowed, (N,).
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
    left, order, here = np.zeros(len(q)), list[int](), begin
    for _ in q:
        order.append(int(np.argmin(np.abs(q - here).max(axis=1) + left)))
        left[order[-1]], here = np.inf, q[order[-1]]
    return np.array(order, dtype=int)


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

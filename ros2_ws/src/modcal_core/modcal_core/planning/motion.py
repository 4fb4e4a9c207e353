"""How an arm goes from one posture to another: a free way in the joints' space, and a motion along it.

Ways are straight there. Where one would touch something, a way over other allowed postures is looked for: a roadmap
whose edges are checked only when a shortest way wants to use them (lazy PRM; Bohlin & Kavraki 2000). The checks are
those of whoever asks, at steps of 0.02 rad; they do not take the place of a motion planner's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from modcal_core.geometry import Array

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

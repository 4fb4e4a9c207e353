"""The order in which stations are visited, and the way between them, in the joints' space.

Ways are straight there. Where one would touch something, a way over other postures that are allowed is looked for: a
roadmap whose edges are checked only when a shortest way wants to use them (lazy PRM; Bohlin & Kavraki 2000). The checks
are those of the spheres, at steps of 0.05 rad; they do not take the place of a motion planner's.

A return is left in between and come back to from another side: as many joints as possible arrive in the other
direction than the first time, so that backlash is part of what is seen. Returns are spread over the whole tour, and
the time between the two visits is short for every other one and long for the rest, so that a slow drift, which grows
with that time, is told from scatter, which does not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from modcal_core.errors import BadCommand, BadTable
from modcal_core.geometry import Array
from modcal_core.measurements import TRAVEL, require
from modcal_core.robots import vector

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


_STEP = 0.05  # rad or m, of the joint that moves most
_NEIGHBOURS = 20  # nearest stations that a route is improved with
_TRIED = 200  # ways over the roadmap before one is given up
_ROUNDS = 20  # iterations

Free = Callable[[Array], np.ndarray]


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
    first = 0 if start is None else int(np.argmin(np.abs(q - start).max(axis=1)))
    order = _shortened(q, _nearest(q, first))
    tour = with_returns(q[order], returns)
    order = order[tour.order]
    roadmap = _Roadmap(np.concatenate([q[order], between]), free)
    ways, blocked = [], []
    for i in range(len(order) - 1):
        way = roadmap.way(i, i + 1)
        if way is None:
            blocked.append(i)
        ways.append(np.empty((0, q.shape[1])) if way is None else way)
    return Route(order, tuple(ways), tuple(blocked), tour.pairs)


def _nearest(q: Array, first: int) -> np.ndarray:
    left, order = set(range(len(q))) - {first}, [first]
    while left:
        rest = np.array(sorted(left))
        order.append(int(rest[np.argmin(np.abs(q[rest] - q[order[-1]]).max(axis=1))]))
        left.discard(order[-1])
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


class _Roadmap:
    """Allowed postures (N, n), and the ways between near ones, each free until it has been looked at.

    It is drawn when the first straight way is not free; of most plans all are.
    """

    def __init__(self, q: Array, free: Free) -> None:
        self.q, self.free, self.drawn = q, free, False

    def _draw(self) -> None:
        from scipy.spatial import cKDTree

        q, self.drawn = self.q, True
        near = cKDTree(q).query(q, k=min(_NEIGHBOURS + 1, len(q)), p=np.inf)[1].reshape(len(q), -1)
        ends = np.stack([np.repeat(np.arange(len(q)), near.shape[1]), near.ravel()], axis=1)
        self.edges = np.unique(np.sort(ends[ends[:, 0] != ends[:, 1]], axis=1), axis=0)
        self.length = np.abs(q[self.edges[:, 0]] - q[self.edges[:, 1]]).max(axis=1)
        self.number = {(int(a), int(b)): i for i, (a, b) in enumerate(self.edges)}
        self.open = np.ones(len(self.edges), dtype=bool)
        self.looked_at = np.zeros(len(self.edges), dtype=bool)

    def way(self, a: int, b: int) -> Array | None:
        """Postures between two of the map, (m, n): none where the straight way is free; None where no way is."""
        if self.free(_line(self.q[a], self.q[b])).all():
            return np.empty((0, self.q.shape[1]))
        if not self.drawn:
            self._draw()
        for _ in range(_TRIED):
            path = self._shortest(a, b)
            if path is None:
                return None
            if self._free_all_along(path):
                return np.array(self.q[path[1:-1]])
        return None

    def _free_all_along(self, path: list[int]) -> bool:
        """Whether every way on a path is free; the first one that is not is closed."""
        for i, j in pairwise(path):
            k = self.number[min(i, j), max(i, j)]
            if not self.looked_at[k]:
                self.looked_at[k] = True
                self.open[k] = self.free(_line(self.q[i], self.q[j])).all()
            if not self.open[k]:
                return False
        return True

    def _shortest(self, a: int, b: int) -> list[int] | None:
        from scipy.sparse import csr_matrix
        from scipy.sparse.csgraph import dijkstra

        there = self.edges[self.open]
        graph = csr_matrix((self.length[self.open], there.T), shape=(len(self.q),) * 2)
        length, before = dijkstra(graph, directed=False, indices=np.array(a), return_predecessors=True)
        if not np.isfinite(length[b]):
            return None
        path = [b]
        while path[-1] != a:
            path.append(int(before[path[-1]]))
        return path[::-1]


def _line(a: Array, b: Array) -> Array:
    count = max(2, int(np.ceil(np.abs(b - a).max() / _STEP)) + 1)
    return a + (b - a) * np.linspace(0.0, 1.0, count)[:, None]


# --- Stations as plain data: joints by name, one list of positions a station

_STATIONS = {"type": ["array", "null"], "items": {"type": "object"}}
_SCHEMA = {
    "type": "object",
    "properties": {
        "joints": {"type": "array", "items": {"type": "string"}},
        "stations": _STATIONS,
        "ties": {"type": ["array", "null"], "items": {"type": "object", "properties": {"stations": _STATIONS}}},
    },
}


def stations_from_data(data: Any, names: Sequence[str], source: str) -> Array:
    """Postures (N, n) [rad, m] of these joints in what a plan.yaml holds. Raises BadTable."""
    if not isinstance(data, Mapping) or data.get("modcal_plan") != 1:
        raise BadTable(source, "is not a plan: modcal_plan is not 1", "give the plan.yaml that modcal plan wrote")
    joints = data.get("joints")
    if not isinstance(joints, Sequence) or isinstance(joints, str):
        raise BadTable(source, "names no joints", "give the plan.yaml that modcal plan wrote")
    require(data, _SCHEMA, source, "give the plan.yaml that modcal plan wrote")
    rows = list(data.get("stations") or ())
    rows += [station for tie in data.get("ties") or () for station in tie.get("stations") or ()]
    values = [
        vector(row.get("position") if isinstance(row, Mapping) else None, len(joints), f"{source}, station {i + 1}")
        for i, row in enumerate(rows)
    ]
    return _of_joints(values, [str(j) for j in joints], names, source)


def stations_from_rows(rows: Sequence[Sequence[str]], names: Sequence[str], source: str) -> Array:
    """Postures (N, n) [rad, m] of these joints in a table whose first row names its columns. Raises BadTable."""
    head = [cell.strip() for cell in rows[0]] if rows else []
    full = [row for row in rows[1:] if any(cell.strip() for cell in row)]
    wanted = [k for k, name in enumerate(head) if name in names]
    values = [
        vector([row[k] if k < len(row) else "" for k in wanted], len(wanted), f"{source}, row {i + 2}")
        for i, row in enumerate(full)
    ]
    return _of_joints(values, [head[k] for k in wanted], names, source)


def _of_joints(values: Sequence[Array], joints: Sequence[str], names: Sequence[str], source: str) -> Array:
    for name in names:
        if joints.count(name) != 1:
            raise BadTable(f"{source}: joint {name}", "is not named once", f"name {', '.join(names)}")
    if not values:
        raise BadTable(source, "holds no station", "give one row a station")
    return np.stack(values)[:, [joints.index(name) for name in names]]


# --- A trajectory as ``modcal plan`` writes it, read back and checked, and led up to from where the arm stands

_RISE = 1.5  # peak of a cubic's speed over its mean
_MIN_LEAD = 0.5  # s from the start to the first point
_MAX_POINTS = 100_000  # of a file, for memory
_FORM = "give joint_names and points with positions and time_from_start, as modcal plan writes them"


@dataclass(frozen=True)
class Trajectory:
    """Postures q (k, n) [rad, m] of these joints at times t (k,) [s], at rest at each of them."""

    names: tuple[str, ...]
    t: Array
    q: Array

    def led_up_to(self, position: Array, speed: float, farthest: float) -> Trajectory:
        """The trajectory, its first point reached from ``position`` (n,) at no more than ``speed`` [rad/s, m/s].

        Raises BadCommand where a joint would have to go farther than ``farthest`` [rad, m]: nobody has looked at that
        way.
        """
        off = np.abs(self.q[0] - position)
        if not off.max() <= farthest:
            worst = int(np.argmax(off))
            said = f"is {off[worst]:.3g} from the first point, {farthest:g} is the limit"
            raise BadCommand(f"joint {self.names[worst]}", said, "bring the arm to the first point before")
        lead = max(_RISE * float(off.max()) / speed, _MIN_LEAD)
        return Trajectory(self.names, self.t - self.t[0] + lead, self.q)


def trajectory_from_data(data: Any, source: str) -> Trajectory:
    """The trajectory in the content of a YAML file; raises BadTable for anything that is not one."""
    try:
        if not isinstance(data, Mapping):
            raise TypeError(f"{type(data).__name__} at the top")
        names = tuple(str(name) for name in data["joint_names"])
        points = list(data["points"])
        if not points or len(points) > _MAX_POINTS or not names or len(set(names)) != len(names):
            raise ValueError(f"{len(points)} points for joints {', '.join(names)}")
        q = np.array([[float(x) for x in point["positions"]] for point in points])
        after = [point["time_from_start"] for point in points]
        t = np.array([float(d["sec"]) + 1e-9 * float(d["nanosec"]) for d in after])
    except (KeyError, TypeError, ValueError) as error:
        raise BadTable(source, f"is not a trajectory ({error!r})", _FORM) from error
    if q.shape != (len(points), len(names)) or not (np.isfinite(q).all() and np.isfinite(t).all()):
        raise BadTable(source, f"its positions are not {len(names)} finite numbers each", _FORM)
    if t[0] < 0.0 or not (np.diff(t) > 0.0).all():
        raise BadTable(source, "its times do not rise from zero", _FORM)
    return Trajectory(names, t, q)

"""The way through stations: short, free, and honest where there is none."""

from __future__ import annotations

from itertools import pairwise, permutations

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.planning.route import route


def everywhere(q: Array) -> np.ndarray:
    return np.ones(len(q), dtype=bool)


def test_nearly_the_shortest_order() -> None:
    rng = np.random.default_rng(1)
    for _ in range(5):
        q = rng.uniform(-2, 2, (7, 3))
        found = route(q, everywhere, q, start=q[3])
        assert sorted(found.order) == list(range(7))
        assert found.order[0] == 3
        lengths = [
            np.abs(np.diff(q[[3, *rest]], axis=0)).max(axis=1).sum() for rest in permutations([0, 1, 2, 4, 5, 6])
        ]
        assert found.length(q[found.order]) <= 1.15 * min(lengths)


def wall(q: Array) -> np.ndarray:
    """A wall at x = 0 with a gap at y > 1."""
    return (np.abs(q[:, 0]) > 0.1) | (q[:, 1] > 1.0)


def test_ways_go_round_what_stands_between() -> None:
    rng = np.random.default_rng(2)
    q = np.array([[-1.0, 0.0], [1.0, 0.0], [-1.0, 0.5]])
    between = rng.uniform(-2, 2, (300, 2))
    found = route(q, wall, between[wall(between)], start=q[2])
    assert found.blocked == ()
    for stop in found.stops(q[found.order]):
        for a, b in pairwise(stop):
            assert wall(a + (b - a) * np.linspace(0.0, 1.0, 100)[:, None]).all()
    assert sum(len(way) for way in found.ways) >= 1


def test_where_no_way_is_it_is_said() -> None:
    def closed(q: Array) -> np.ndarray:
        return np.abs(q[:, 0]) > 0.1

    q = np.array([[-1.0, 0.0], [1.0, 0.0], [1.5, 0.2]])
    between = np.random.default_rng(3).uniform(-2, 2, (100, 2))
    found = route(q, closed, between[closed(between)], start=q[0])
    assert found.blocked == (0,)
    assert len(found.ways) == 2

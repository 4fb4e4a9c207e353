"""Returns of a tour, its way through stations, the designs of postures, and stations for a Delta."""

from __future__ import annotations

import json
from itertools import combinations, pairwise, permutations, product
from pathlib import Path

import numpy as np
import pytest
from cells import ur10
from deltas import FILE, nominal

from modcal_core.errors import BadTable
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.dwells import returns
from modcal_core.measurements.inspection import inspect
from modcal_core.planning.planner import PlanRequest, plan
from modcal_core.planning.route import RETURNS, route, with_returns
from modcal_core.planning.sensitivity_study import array_postures, orthogonal_array
from modcal_core.planning.site import Site
from modcal_core.robots.mechanism import takes
from modcal_msgs_py.mcap_read import read_recording
from modcal_nodes.cli.main import run
from modcal_nodes.simulation.program import tour

URDF = Path(__file__).resolve().parents[2] / "examples" / "robots" / "ur10.urdf"


def postures(count: int, seed: int = 0) -> Array:
    return np.random.default_rng(seed).uniform(-1.2, 1.2, (count, 6))


@pytest.mark.parametrize("count", [18, 24, 60, 97, 400])
def test_six_distinct_postures_left_in_between_and_come_back_to_from_another_side(count: int) -> None:
    q = postures(count)
    found = with_returns(q)
    stops = q[found.order]
    assert len(stops) == count + RETURNS
    assert len({int(found.order[first]) for first, _ in found.pairs}) == RETURNS
    lags = []
    for first, second in found.pairs:
        assert np.array_equal(stops[first], stops[second])
        assert second - first > 1
        ways = (stops[first] - stops[first - 1]) * (stops[second] - stops[second - 1])
        assert (ways < 0.0).any()
        lags.append((second - first) / count)
    # some follow soon, some late, and they do not stand together: a drift is told from scatter
    assert min(lags) < 0.2
    assert max(lags) > 0.5
    seconds = np.sort([second for _, second in found.pairs])
    assert seconds[-1] - seconds[0] > 0.6 * count
    assert len(returns(stops)) == RETURNS
    assert returns(q) == []


def test_a_short_tour_and_one_that_is_not_to_return_have_none() -> None:
    assert not with_returns(postures(17)).pairs
    assert not with_returns(postures(60), 0).pairs
    assert np.array_equal(with_returns(postures(60), 0).order, np.arange(60))


def test_a_way_that_cannot_be_gone_is_not_gone() -> None:
    """The first joint may not move from below zero to above 0.5."""

    def passable(a: Array, b: Array) -> bool:
        return not (a[0] < 0.0 and b[0] > 0.5)

    q = postures(60)
    found = with_returns(q, passable=passable)
    assert len(found.pairs) == RETURNS
    stops = q[found.order]
    for _, second in found.pairs:
        assert passable(stops[second - 1], stops[second])
        assert second + 1 == len(stops) or passable(stops[second], stops[second + 1])


def test_what_is_a_return_and_what_is_none() -> None:
    q = postures(5)
    assert returns(q[[0, 0, 0, 1, 2]]) == []  # standing still
    assert returns(q[[3, 0, 4, 0]])[0].tolist() == [1, 3]
    assert returns(q[[3, 0, 3, 0]]) == []  # from the same side again
    assert returns(q[[0, 1, 0]]) == []  # from where the first one was reached is not known
    assert returns(q[[3, 0, 0, 4, 0]] + 1e-5 * postures(5, 1))[0].tolist() == [1, 4]
    never_left = q[[3, 0, 0, 0]] + 1e-2 * np.array([0.0, 0.0, 1.0, 0.0])[:, None]
    assert returns(never_left) == []


def test_the_simulated_tour_keeps_its_postures_and_comes_back() -> None:
    plain = tour(ur10(), 40, 0.5, 0.5, np.random.default_rng(3))
    back = tour(ur10(), 40, 0.5, 0.5, np.random.default_rng(3), RETURNS)
    assert len(back) == len(plain) + 2 * RETURNS
    assert {tuple(q) for _, q in plain} == {tuple(q) for _, q in back}
    assert np.allclose(np.diff([t for t, _ in back]), 0.5)


@pytest.mark.slow
def test_a_simulated_bag_has_returns_and_info_says_when_one_has_none(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    few = ("-p", "stations=24", "-p", "joint_rate_hz=50", "-p", "tracker_rate_hz=20")
    for name, options in (("with", ()), ("without", ("--returns", "0"))):
        assert run(["simulate", str(URDF), "--out", str(tmp_path / name), *few, *options]) == 0
    capfd.readouterr()
    assert run(["info", str(tmp_path / "with")]) == 0
    told = " ".join(capfd.readouterr().out.split())
    assert "30 dwells" in told
    assert "noise floor" not in told
    assert run(["info", str(tmp_path / "without")]) == 0
    told = " ".join(capfd.readouterr().out.split())
    assert "24 dwells" in told
    assert "No posture is visited twice: the noise floor will be unknown; visit 6 postures again" in told
    assert not [f for f in inspect(read_recording(tmp_path / "with")).findings if "noise floor" in f]


def everywhere(q: Array) -> np.ndarray:
    return np.ones(len(q), dtype=bool)


def length(q: Array) -> float:
    return float(np.abs(np.diff(q, axis=0)).max(axis=1).sum())


def test_nearly_the_shortest_order() -> None:
    rng = np.random.default_rng(1)
    for _ in range(5):
        q = rng.uniform(-2, 2, (7, 3))
        found = route(q, everywhere, q, start=q[3])
        assert sorted(found.order) == list(range(7))
        assert found.order[0] == 3
        orders = ([3, *rest] for rest in permutations([0, 1, 2, 4, 5, 6]))
        assert length(q[found.order]) <= 1.15 * min(length(q[order]) for order in orders)


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


@pytest.mark.parametrize(
    ("factors", "levels", "runs"), [(6, 5, 25), (3, 2, 4), (7, 2, 8), (4, 3, 9), (8, 7, 49), (7, 5, 125)]
)
def test_every_pair_of_levels_equally_often(factors: int, levels: int, runs: int) -> None:
    array = orthogonal_array(factors, levels)
    assert array.shape == (runs, factors)
    for a, b in combinations(range(factors), 2):
        counts = {pair: 0 for pair in product(range(levels), repeat=2)}
        for row in array:
            counts[int(row[a]), int(row[b])] += 1
        assert set(counts.values()) == {runs // levels**2}


def test_l25_is_the_one_in_the_books() -> None:
    """Taguchi's L25(5^6): columns i, j, i + j, i + 2 j, i + 3 j, i + 4 j mod 5, up to the order of the last four."""
    array = orthogonal_array(6, 5)
    i, j = array[:, 0], array[:, 1]
    assert np.array_equal(i, np.repeat(range(5), 5))
    assert np.array_equal(j, np.tile(range(5), 5))
    assert {tuple(c) for c in array[:, 2:].T} == {tuple((i + k * j) % 5) for k in range(1, 5)}


def test_an_array_that_would_be_huge_is_refused() -> None:
    with pytest.raises(BadTable, match="20000 are the limit"):
        orthogonal_array(40, 31)


def test_levels_are_different_angles() -> None:
    """From −2π to 2π in five levels three would be one angle; they are spread over a turn instead."""
    q = array_postures(ur10())
    for k in range(6):
        assert len(np.unique(np.round(np.exp(1j * q[:, k]), 9))) == 5
        assert (q[:, k] >= ur10().lower[k]).all()


@pytest.mark.slow
def test_stations_that_its_platform_can_take() -> None:
    delta = nominal()
    found = plan(delta, Site(), PlanRequest(24, None, candidates=150), np.random.default_rng(0))
    assert takes(delta, found.q).all()
    assert found.distinct == 24
    assert found.expected.left < found.expected.at_random


def test_designs_hold_postures_that_exist() -> None:
    assert takes(nominal(), array_postures(nominal())).all()


@pytest.mark.slow
def test_verbs_take_a_delta(tmp_path: Path) -> None:
    out = tmp_path / "plan"
    asked = ["plan", str(FILE), "--stations", "24", "--candidates", "120", "--out", str(out)]
    assert run(asked) == 0
    assert (out / "report.html").exists()
    out = tmp_path / "sensitivity"
    assert run(["sensitivity", str(FILE), "--out", str(out)]) == 0
    data = json.loads((out / "sensitivity.json").read_text())
    assert data["joints"] == list(nominal().names)

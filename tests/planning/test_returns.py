"""Returns: postures that a tour comes back to, so that it is known what the arm does not repeat."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cells import ur10

from modcal_core.geometry.so3 import Array
from modcal_core.measurements.dwells import returns
from modcal_core.measurements.inspection import inspect
from modcal_core.planning.route import RETURNS, with_returns
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

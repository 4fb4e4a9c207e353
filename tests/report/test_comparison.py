"""Two calibrations side by side: the same arm twice shows no difference, another arm does, as large as it is."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from cells import samples_of, slider_arm, ur10
from scipy.optimize import least_squares

from modcal_core.calibration.store import Calibration
from modcal_core.errors import BadRobot, NotEnoughData
from modcal_core.geometry import se3, so3
from modcal_core.loop import calibrate
from modcal_core.outcome import tool_difference
from modcal_core.outcome.contents import Outcome
from modcal_core.report.as_json import to_json_data
from modcal_core.report.blocks import text
from modcal_core.report.comparison import Side, compare
from modcal_nodes.simulation.world import World


@cache
def world(seed: int) -> World:
    rng = np.random.default_rng(seed)
    return World(
        ur10(), rng, 5e-4, 1e-3, se3.exp([1.0, 0.2, 0.1, 0.3, 0.2, -1.0]), se3.exp([0.05, 0.03, 0.12, 0, 0, 0])
    )


@cache
def session(of: int, seed: int, remounted: bool = False) -> tuple[Calibration, Outcome]:
    """A calibration of an arm; a tracker and a target that stand elsewhere, where remounted."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-np.pi, np.pi, (60, 6))
    T = world(of).tool_in_tracker(q)
    T[:, :3, 3] += 5e-5 * rng.standard_normal((60, 3))
    T[:, :3, :3] = T[:, :3, :3] @ so3.exp(5e-5 * rng.standard_normal((60, 3)))
    if remounted:
        T = se3.exp([-0.4, 1.0, 0.2, -0.7, 0.5, 0.9]) @ T @ se3.exp([0.02, -0.05, 0.08, 0.6, -0.4, 1.1])
    found = calibrate(samples_of(ur10(), q, T), ur10(), np.random.default_rng(0), look_for_effects=False)
    return found.calibration, found.report


def side(name: str, of: int, seed: int, remounted: bool = False) -> Side:
    calibration, report = session(of, seed, remounted)
    return Side(name, calibration, to_json_data(report))


@pytest.mark.slow
@pytest.mark.parametrize("remounted", [False, True])
def test_the_same_arm_twice_shows_no_difference(remounted: bool) -> None:
    found = compare(side("a", 1, 10), side("b", 1, 11, remounted), 0.2).data
    assert found["result"] == "same"
    assert found["tool"]["mm"]["rms"] < found["tool"]["expected_rms_mm"] < 0.1
    assert not any(p["shown"] for p in found["parameters"])


@pytest.mark.slow
def test_another_arm_differs_by_as_much_as_the_arms_do() -> None:
    """The size by MuJoCo's poses of both arms, base and tool fitted by a solver of its own."""
    found = compare(side("a", 1, 10), side("b", 2, 11), 0.2).data
    assert found["result"] == "beyond tolerance"
    q = tool_difference(session(1, 10)[0], session(2, 11)[0]).q
    # the worlds' own trackers and targets are the same, so that poses of the tool can be compared
    T, other = (world(k).tool_in_tracker(q) for k in (1, 2))

    def left(x: np.ndarray) -> np.ndarray:
        moved = se3.exp(x[:6]) @ T @ se3.exp(x[6:])
        turn = so3.log(other[:, :3, :3] @ np.swapaxes(moved[:, :3, :3], 1, 2))
        return np.c_[other[:, :3, 3] - moved[:, :3, 3], turn].ravel()

    truth = left(least_squares(left, np.zeros(12)).x).reshape(-1, 6)[:, :3]
    rms = 1e3 * np.sqrt(np.mean(np.sum(truth**2, axis=1)))
    assert found["tool"]["mm"]["rms"] == pytest.approx(rms, rel=0.05)
    assert sum(bool(p["shown"]) for p in found["parameters"]) > 5


def test_reports_alone_are_compared_by_their_intervals() -> None:
    one, other = side("a", 1, 10), side("b", 1, 11)
    worse = {
        **(other.report or {}),
        "error_mm": {"final": {**(one.report or {})["error_mm"]["final"], "rms": 9.0, "rms_ci95": [8, 10]}},
    }
    alone = Side("a", report=one.report)
    assert compare(alone, Side("b", report=one.report)).data["result"] == "same"
    found = compare(alone, Side("b", report=worse))
    assert found.data["result"] == "differs"
    assert found.data["tool"] is None
    assert found.data["verdict"] in text(found.said)
    assert "do not overlap" in text(found.said)


def test_what_cannot_be_compared_is_refused() -> None:
    one = side("a", 1, 10)
    joints = {**(one.report or {}), "recording": {"joints": list(slider_arm().names)}}
    with pytest.raises(BadRobot, match="compare calibrations of one arm"):
        compare(one, Side("b", report=joints))
    with pytest.raises(NotEnoughData, match="holds no error to compare"):
        compare(one, Side("b", report={"modcal_report": 1}))

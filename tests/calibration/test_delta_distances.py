"""A Delta from distances alone: what is recovered, what cannot be, and how annealing fares beside least squares."""

from __future__ import annotations

import numpy as np
import pytest
from deltas import NOISE_M, RecordedDelta, nominal, postures, record_delta
from finite_differences import assert_jacobian

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.delta_distances import (
    Pairs,
    Schedule,
    anneal,
    anneal_distances,
    distance_errors,
    distance_jacobian,
    fit_distances,
    max_deviations,
    objective,
    visibility,
)
from modcal_core.calibration.fit import identify
from modcal_core.calibration.initial import procrustes
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.delta import Delta
from modcal_core.robots.delta_kinematics import tool_pose

HELD_OUT = 100
UNSEEN = ("arm_1/azimuth", "tool/z", "tool/rx", "tool/ry", "tool/rz")  # held, what is left can be told one by one


def held(delta: Delta) -> Array:
    max_deviation = max_deviations(delta)
    max_deviation[[delta.parameter_names.index(name) for name in UNSEEN]] = 0.0
    return max_deviation


def missed(fitted: Delta, cell: RecordedDelta, count: int) -> float:
    """RMS distance [m] of held-out readings, the frame found from the ones that were fitted."""
    q, y = cell.samples.q, cell.samples.reading
    T = procrustes(tool_pose(fitted, q[:count])[:, :3, 3], y[:count])
    gap = y[count:] - se3.apply(T, tool_pose(fitted, q[count:])[:, :3, 3])
    return float(np.sqrt(np.mean(np.sum(gap**2, axis=1))))


def missed_by_points(cell: RecordedDelta, count: int) -> float:
    """The same for the fit to points in a frame that is found with the robot."""
    train = cell.samples.select(np.arange(count))
    start = fit_cell(cell.nominal, train, Cell()).model
    fit = identify(start, train, choose_parameters(start, views_of(train)).parameters)
    gap = cell.samples.reading[count:] - fit.model.predict(cell.samples.q[count:])[:, :3, 3]
    return float(np.sqrt(np.mean(np.sum(gap**2, axis=1))))


@pytest.mark.slow
@pytest.mark.parametrize("count", [20, 50, 200])
def test_planted_errors_are_recovered_to_the_noise_floor(count: int) -> None:
    """As near as least squares can come: with n equations and P unknowns, σ² (1 + P / (n − P − 1)) is to be expected."""
    floor = NOISE_M * np.sqrt(3.0)
    expected = floor * np.sqrt(1.0 + 25.0 / (3.0 * count - 26.0))
    by_distances, by_points, before = [], [], []
    for seed in (1, 2):
        cell = record_delta(seed, count + HELD_OUT)
        pairs = Pairs.of_points(cell.samples.reading[:count])
        found = fit_distances(cell.nominal, cell.samples.q[:count], pairs)
        assert not found.at_bound
        by_distances.append(missed(found.delta, cell, count))
        by_points.append(missed_by_points(cell, count))
        before.append(missed(cell.nominal, cell, count))
    assert np.mean(before) > 8.0 * floor
    assert np.mean(by_points) < 1.15 * expected
    assert np.mean(by_distances) < 1.5 * expected


def test_parameters_come_back_within_their_deviations() -> None:
    """Those that distances can tell, over several robots: scores as of a normal law."""
    drawn = nominal()
    max_deviation = held(drawn)
    free = max_deviation > 0.0
    rng = np.random.default_rng(5)
    scores = []
    for seed in range(6):
        q = postures(drawn, 40, seed)
        X = drawn.vector + np.where(free, 5e-4 * rng.standard_normal(24), 0.0)
        y = tool_pose(drawn.with_vector(X), q)[:, :3, 3] + NOISE_M * rng.standard_normal((40, 3))
        found = fit_distances(drawn, q, Pairs.of_points(y), max_deviation)
        assert (found.std[~free] == 0.0).all()
        scores.append((found.delta.vector - X)[free] / found.std[free])
    assert 0.75 < np.std(scores) < 1.3
    assert np.abs(scores).max() < 4.5


def test_jacobian_of_distances_is_their_derivative() -> None:
    delta = nominal()
    q = postures(delta, 4)
    pairs = Pairs.of_points(np.zeros((4, 3)))
    J = distance_jacobian(delta, q, pairs)
    assert_jacobian(lambda X: -distance_errors(delta.with_vector(X), q, pairs), J, delta.vector)


@pytest.mark.parametrize(("shaft", "rank", "unseen"), [(True, 19, 5), (False, 17, 7)])
def test_what_distances_cannot_tell(shaft: bool, rank: int, unseen: int) -> None:
    delta = nominal(shaft)
    q = postures(delta, 40)
    pairs = Pairs.of_points(np.zeros((len(q), 3)))
    seen = visibility(delta, q, pairs)
    assert seen.rank == rank
    assert len(seen.unseen) == unseen
    assert any("azimuths of all arms together" in words for words in seen.unseen)
    assert any(words.startswith("tool/z") for words in seen.unseen)
    assert np.isfinite(seen.condition)


def test_what_cannot_be_told_changes_no_distance() -> None:
    """A tenth of a radian at all azimuths, the tool turned along, and the tool lifted: not only to first order."""
    delta = nominal()
    q = postures(delta, 10)
    pairs = Pairs.of_points(tool_pose(delta, q)[:, :3, 3])
    X = delta.vector.copy()
    X[6:9] += 0.1
    x, y = X[18:20]
    X[18:20] = np.cos(0.1) * x - np.sin(0.1) * y, np.sin(0.1) * x + np.cos(0.1) * y
    X[20] += 0.05
    assert np.abs(distance_errors(delta.with_vector(X), q, pairs)).max() < 1e-12
    X[6] += 1e-3
    assert np.abs(distance_errors(delta.with_vector(X), q, pairs)).max() > 1e-5


def test_few_postures_are_said_to_tell_less() -> None:
    delta = nominal()
    q = postures(delta, 6)
    pairs = Pairs.of_points(np.zeros((6, 3)))
    seen = visibility(delta, q, pairs)
    assert seen.rank <= 12  # 3 · 6 coordinates less the six of a frame
    assert len(seen.unseen) == 24 - seen.rank
    with pytest.raises(NotEnoughData, match="15 distances: 12 independent ones"):
        fit_distances(delta, q, pairs)
    with pytest.raises(NotEnoughData, match="2 distances: 2 independent ones"):
        fit_distances(delta, postures(delta, 40), Pairs(np.array([0, 1]), np.array([2, 3]), np.array([0.1, 0.1])))


def test_distances_of_a_calliper_need_no_tracker() -> None:
    """Each distance measured by itself between marks, as on a printed part: only the planted error at a bound stays out."""
    cell = record_delta(4, 60)
    rng = np.random.default_rng(0)
    first, second = rng.permuted(np.tile(np.arange(60), (4, 1)), axis=1).reshape(2, -1)
    apart = first != second
    exact = cell.world.tool_in_tracker(cell.samples.q)[:, :3, 3]
    length = np.linalg.norm(exact[first] - exact[second], axis=1)[apart]
    pairs = Pairs(first[apart], second[apart], length + 2e-5 * rng.standard_normal(apart.sum()))
    found = fit_distances(cell.nominal, cell.samples.q, pairs)
    assert found.before > 5e-4
    assert 1.2e-5 < found.f < 2.5e-5
    every = Pairs.of_points(exact)
    assert objective(found.delta, cell.samples.q, every) < 0.1 * objective(cell.nominal, cell.samples.q, every)


def test_bounds_hold_and_are_named() -> None:
    cell = record_delta(5, 60)
    max_deviation = max_deviations(cell.nominal)
    max_deviation[15:18] = 1e-5  # the rods of the drawing are believed to 0.01 mm, and are wrong by more
    found = fit_distances(cell.nominal, cell.samples.q, Pairs.of_points(cell.samples.reading), max_deviation)
    assert (np.abs(found.delta.vector - cell.nominal.vector) <= max_deviation * (1.0 + 1e-9)).all()
    assert set(found.at_bound) & {"arm_1/distal", "arm_2/distal", "arm_3/distal"}


def test_annealing_gets_better_and_least_squares_gets_there() -> None:
    cell = record_delta(6, 30)
    pairs = Pairs.of_points(cell.samples.reading)
    before = objective(cell.nominal, cell.samples.q, pairs)
    plan = Schedule(trials=15, cooling=0.75)
    annealed, went = anneal_distances(cell.nominal, cell.samples.q, pairs, np.random.default_rng(0), plan)
    assert went.f == objective(annealed, cell.samples.q, pairs)
    assert (np.diff(went.history) <= 0.0).all()
    assert went.evaluations == 1 + 15 * len(went.history)
    assert went.f < 0.9 * before
    polished = fit_distances(cell.nominal, cell.samples.q, pairs, begin=annealed)
    direct = fit_distances(cell.nominal, cell.samples.q, pairs)
    assert direct.f < went.f
    assert abs(polished.f - direct.f) < 1e-3 * direct.f
    assert direct.evaluations < went.evaluations


def test_annealing_climbs_out_of_a_hollow() -> None:
    """f has a shallow minimum at the start and a deep one beyond a ridge: heat is what leads over it."""

    def f(x: Array) -> float:
        return float((x[0] ** 2 - 1.0) ** 2 + 0.3 * x[0])

    start = np.array([1.0])
    hot = anneal(f, start, np.random.default_rng(0), Schedule(step=0.6, trials=80, first=1.0, last=1e-3, cooling=0.8))
    cold = anneal(
        f, start, np.random.default_rng(0), Schedule(step=0.6, trials=80, first=1e-9, last=1e-10, cooling=0.8)
    )
    assert abs(hot.X[0] + 1.03) < 0.05
    assert cold.X[0] > 0.5
    bounded = anneal(
        f, start, np.random.default_rng(0), Schedule(step=0.6, first=1.0, last=1e-2), np.array([-0.5]), np.array([2.0])
    )
    assert -0.5 <= bounded.X[0] <= 2.0


def test_postures_that_the_drawing_cannot_take_are_refused() -> None:
    wide = Delta.build(["a", "b", "c"], offset=0.5, proximal=0.3, distal=0.7)
    q = np.r_[np.zeros((2, 3)), np.full((3, 3), 1.2)]
    with pytest.raises(BadRecording, match="2 of 5 cannot be reached"):
        fit_distances(wide, q, Pairs.of_points(np.eye(5, 3)))

"""A Delta: the whole loop from points, and its constants from distances alone."""

from __future__ import annotations

import numpy as np
import pytest
from deltas import NOISE_M, nominal, postures, record_delta
from finite_differences import assert_jacobian

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.delta_distances import (
    Pairs,
    Schedule,
    anneal_distances,
    distance_errors,
    distance_jacobian,
    fit_distances,
    max_deviations,
    objective,
    visibility,
)
from modcal_core.calibration.linearisation import linearise
from modcal_core.calibration.noise import errors
from modcal_core.calibration.store import from_data, to_data
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.effects.effect import ALL, AXIS, Effect
from modcal_core.effects.shapes import Shape
from modcal_core.errors import BadRecording, NotEnoughData, NotReachable
from modcal_core.loop import calibrate
from modcal_core.report.report import to_json_data
from modcal_core.robots.delta import Delta
from modcal_core.robots.delta_kinematics import tool_pose

FLOOR_MM = 1e3 * NOISE_M * np.sqrt(3.0)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "shaft"), [("pose", True), ("point", False)])
def test_derivatives_of_a_delta_in_its_cell(kind: str, shaft: bool) -> None:
    """Of positions; of orientations the derivative of the logarithm is left out on purpose."""
    cell = record_delta(2, 12, kind, shaft)
    model = fit_cell(cell.nominal, cell.samples, Cell()).model
    effects = (
        Effect("gear_harmonic", "arm_2", AXIS, "position:arm_2", Shape("sine", {"cycles": 20.0})).with_values([1e-3, 2e-3, 20.0]),
        Effect("axis_wobble", "arm_1", "across", "position:arm_1", Shape("turn", {"cycles": 1.0})).with_values(np.zeros(4)),
        Effect("step", "base", ALL, "time", Shape("step", {"at": float(cell.samples.stamps[5])})).with_values(np.zeros(6)),
    )  # fmt: skip
    start = model.with_effects(effects)
    parameters = choose_parameters(model, views_of(cell.samples)).parameters
    values = np.concatenate([1e-3 * np.arange(len(parameters)) / 10.0, *(e.values for e in effects)])
    at = linearise(start, parameters, values, cell.samples)
    N = len(cell.samples)

    def positions(x: np.ndarray) -> np.ndarray:
        return linearise(start, parameters, x, cell.samples, jacobian=False).position.ravel()

    of_frame = np.array([p.place == 0 for p in parameters] + [False] * (len(values) - len(parameters)))
    moved = ~of_frame  # a frame's own error turns the root as well, which is left out on purpose
    J = at.J[moved, : 3 * N].T

    def others(x: np.ndarray) -> np.ndarray:
        whole = values.copy()
        whole[moved] = x
        return -positions(whole)

    assert_jacobian(others, J, values[moved], tolerance=2e-6)


@pytest.mark.parametrize(("linear", "count"), [(False, 25), (True, 22)])
def test_a_clean_delta_comes_out_clean(linear: bool, count: int) -> None:
    cell = record_delta(1, 160, linear=linear)
    data = to_json_data(calibrate(cell.samples, cell.nominal, np.random.default_rng(0)).report)
    assert data["effects"] == []
    assert data["unexplained"] is None
    assert data["error_mm"]["nominal"]["rms"] > 5.0 * FLOOR_MM
    assert data["error_mm"]["final"]["rms"] < 1.2 * FLOOR_MM
    seen = data["identifiability"]
    # 18 of the arms, 6 of the frame, 3 of the tool, less two; a linear one's base also moves as its towers do
    assert seen["parameters"] == seen["rank"] == count
    assert linear or seen["left_out"] == ["tool/z", "arm_1/azimuth"]


@pytest.mark.slow
def test_a_gear_that_nobody_declared_is_found_and_named() -> None:
    cell = record_delta(2, 160, gear=(1, 60.0, 3e-4))
    result = calibrate(cell.samples, cell.nominal, np.random.default_rng(0))
    data = to_json_data(result.report)
    (found,) = data["effects"]
    named = (found["family"], found["place"], found["direction"], found["driver"])
    assert named == ("gear_harmonic", "arm_2", "axis", "position:arm_2")
    sizes = found["parameters"]
    for name, true in (("cycles_per_turn", 60.0), ("amplitude", 3e-4)):
        assert abs(sizes[name]["value"] - true) < 4.0 * sizes[name]["std"]
    assert found["rms_mm_before"] > 1.4 * found["rms_mm_after"]
    assert data["error_mm"]["geometric"]["rms"] > 1.4 * FLOOR_MM
    assert data["error_mm"]["final"]["rms"] < 1.2 * FLOOR_MM
    assert data["unexplained"] is None
    # the truth of other postures, through the file
    again = from_data(to_data(result.calibration))
    other = record_delta(2, 300, gear=(1, 60.0, 3e-4), noise_m=0.0).samples.select(np.arange(200, 300))
    rms = float(np.sqrt(np.mean(errors(again.calibrated, other).position_norm ** 2)))
    assert rms < 0.6e-3 * FLOOR_MM
    assert again.robot == result.calibration.robot


@pytest.mark.slow
def test_arms_that_give_way_under_the_platform() -> None:
    cell = record_delta(3, 160, compliance=3e-4)
    data = to_json_data(calibrate(cell.samples, cell.nominal, np.random.default_rng(0)).report)
    assert {e["family"] for e in data["effects"]} <= {"compliance"}
    assert {e["driver"] for e in data["effects"]} >= {"load:arm_1", "load:arm_2", "load:arm_3"}
    assert data["error_mm"]["final"]["rms"] < 1.3 * FLOOR_MM


def test_parameters_of_the_arms_come_back() -> None:
    """From points in a frame of which nothing is known: what the arms have of their own, within three deviations."""
    cell = record_delta(7, 200)
    result = calibrate(cell.samples, cell.nominal, np.random.default_rng(0), look_for_effects=False)
    names, X = cell.nominal.parameter_names, cell.true.vector - cell.nominal.vector
    turned = X[names.index("arm_1/azimuth")]  # is left out: the frame takes it
    scores = []
    for name, value, std, _ in result.calibration.parameters:
        place, _, what = name.rpartition("/")
        if place.startswith("arm_"):
            true = X[names.index(name)] - (turned if what == "azimuth" else 0.0)
            scores.append((value - true) / std)
    assert len(scores) == 17
    assert np.abs(scores).max() < 3.5
    assert 0.5 < np.std(scores) < 1.6


def test_joint_positions_that_no_platform_fits_are_refused() -> None:
    cell = record_delta(10, 60)
    short = Delta.build(cell.nominal.names, offset=0.15, proximal=0.3, distal=0.42)
    with pytest.raises(NotReachable, match="no platform fits"):
        calibrate(cell.samples, short, np.random.default_rng(0))


def test_jacobian_of_distances_is_their_derivative() -> None:
    delta = nominal()
    q = postures(delta, 4)
    pairs = Pairs.of_points(np.zeros((4, 3)))
    J = distance_jacobian(delta, q, pairs)
    assert_jacobian(lambda X: -distance_errors(delta.with_vector(X), q, pairs), J, delta.vector)


@pytest.mark.parametrize(
    ("shaft", "linear", "rank", "unseen"), [(True, False, 19, 5), (False, False, 17, 7), (True, True, 16, 8)]
)
def test_what_distances_cannot_tell(shaft: bool, linear: bool, rank: int, unseen: int) -> None:
    delta = nominal(shaft, linear)
    q = postures(delta, 40)
    pairs = Pairs.of_points(np.zeros((len(q), 3)))
    seen = visibility(delta, q, pairs)
    assert seen.rank == rank
    assert len(seen.unseen) == unseen
    assert all(": " in words for words in seen.unseen)  # each is named for what it is
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


def test_postures_that_the_drawing_cannot_take_are_refused() -> None:
    wide = Delta.build(["a", "b", "c"], offset=0.5, proximal=0.3, distal=0.7)
    q = np.r_[np.zeros((2, 3)), np.full((3, 3), 1.2)]
    with pytest.raises(BadRecording, match="2 of 5 cannot be reached"):
        fit_distances(wide, q, Pairs.of_points(np.eye(5, 3)))

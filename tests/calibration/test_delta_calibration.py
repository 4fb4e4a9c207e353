"""The whole loop on a Delta: geometry recovered, what nobody declared found, a clean one clean."""

from __future__ import annotations

import numpy as np
import pytest
from deltas import NOISE_M, record_delta
from finite_differences import assert_jacobian

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.linearisation import linearise
from modcal_core.calibration.noise import errors
from modcal_core.calibration.store import from_data, to_data
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.effects.effect import ALL, AXIS, Effect
from modcal_core.effects.shapes import Shape
from modcal_core.errors import BadRobot, NotReachable
from modcal_core.loop import calibrate
from modcal_core.report.as_json import to_json_data
from modcal_core.robots.delta import Delta

FLOOR_MM = 1e3 * NOISE_M * np.sqrt(3.0)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "shaft"), [("point", True), ("pose", True), ("point", False)])
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


def test_a_clean_delta_comes_out_clean() -> None:
    cell = record_delta(1, 160)
    data = to_json_data(calibrate(cell.samples, cell.nominal, np.random.default_rng(0)).report)
    assert data["effects"] == []
    assert data["unexplained"] is None
    assert data["error_mm"]["nominal"]["rms"] > 5.0 * FLOOR_MM
    assert data["error_mm"]["final"]["rms"] < 1.2 * FLOOR_MM
    seen = data["identifiability"]
    assert seen["parameters"] == seen["rank"] == 25  # 18 of the arms, 6 of the frame, 3 of the tool, less two
    assert seen["left_out"] == ["tool/z", "arm_1/azimuth"]


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


@pytest.mark.slow
def test_a_delta_without_shaft_and_one_with_poses() -> None:
    for kind, shaft in (("point", False), ("pose", True)):
        cell = record_delta(8, 120, kind, shaft)
        data = to_json_data(calibrate(cell.samples, cell.nominal, np.random.default_rng(0)).report)
        assert data["error_mm"]["final"]["rms"] < 1.3 * FLOOR_MM, kind
        assert data["effects"] == []
        assert np.abs(np.array([p["value"] for p in data["parameters"]])).max() < 0.1


def test_what_needs_a_serial_arm_says_so() -> None:
    cell = record_delta(9, 60)
    result = calibrate(cell.samples, cell.nominal, np.random.default_rng(0), look_for_effects=False)
    with pytest.raises(BadRobot, match="is a Delta"):
        _ = result.calibration.calibrated.serial


def test_joint_positions_that_no_platform_fits_are_refused() -> None:
    cell = record_delta(10, 60)
    short = Delta.build(cell.nominal.names, offset=0.15, proximal=0.3, distal=0.42)
    with pytest.raises(NotReachable, match="no platform fits"):
        calibrate(cell.samples, short, np.random.default_rng(0))

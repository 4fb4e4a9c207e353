"""What a calibration leaves behind: its files predict as the fit does, with its uncertainty and the geometry that is best alone."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from cells import record, samples_of, slider_arm, ur10

from modcal_core.calibration.cell import Cell, fit_cell, free_cell
from modcal_core.calibration.final_fit import finalise
from modcal_core.calibration.fit import identify
from modcal_core.calibration.model import Model, place_model
from modcal_core.calibration.parameters import least_change
from modcal_core.calibration.store import Calibration, fingerprint, from_data, to_data
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.effects.drivers import NominalArm
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.shapes import Shape
from modcal_core.errors import BadRobot, BadTable
from modcal_core.evaluation import evaluate
from modcal_core.files import to_yaml
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.report.report import calibration_files
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.urdf import joint_origins, read_chain
from modcal_core.robots.urdf_inertias import HeldBehind, Inertias


@pytest.mark.slow
@pytest.mark.parametrize("chain", [ur10(), slider_arm()], ids=["ur10", "sliders"])
def test_least_change_moves_the_tool_alike(chain: Chain) -> None:
    made = record(8, 120, "pose", chain)
    fit = calibrate(made.samples, chain, np.random.default_rng(0)).scored
    tidy = least_change(fit.model, chain)
    q = made.samples.q
    assert np.abs(tidy.predict(q) - fit.model.predict(q)).max() < 1e-12
    assert np.array_equal(tidy.chain.origins[0], chain.origins[0])
    assert np.array_equal(tidy.chain.origins[-1], chain.origins[-1])
    moved = np.linalg.norm(tidy.chain.origins[1:-1] - chain.origins[1:-1])
    assert moved <= np.linalg.norm(fit.model.chain.origins[1:-1] - chain.origins[1:-1])


@pytest.mark.slow
def test_calibration_survives_its_file() -> None:
    made = record(9, 100)
    made_elsewhere = calibrate(made.samples, ur10(), np.random.default_rng(0)).calibration
    calibration = pickle.loads(pickle.dumps(made_elsewhere))  # as of a worker's process
    again = from_data(yaml.safe_load(to_yaml(to_data(calibration))))
    q = made.samples.q
    assert np.array_equal(again.calibrated.predict(q), calibration.calibrated.predict(q))
    assert again.parameters == calibration.parameters
    assert again.robot == calibration.robot
    assert again.watched == calibration.watched
    assert [p.name for p in again.uncertainty.parameters] == [p.name for p in calibration.uncertainty.parameters]
    assert np.array_equal(again.uncertainty.covariance, calibration.uncertainty.covariance)


def test_an_arm_that_is_held_behind_its_joints_survives_its_file() -> None:
    """As of two arms that look at each other."""
    chain = ur10()
    held = HeldBehind(2, 3.5, np.array([0.1, 0.2, 0.3]))
    inertias = Inertias(np.ones(6), np.zeros((6, 3)), np.zeros((6, 3, 3)), held=held)
    model = replace(place_model(chain, ("tracker",)), arm=NominalArm(chain, inertias))
    calibration = Calibration(model, model, model, np.zeros((2, 6)))
    arm = from_data(yaml.safe_load(to_yaml(to_data(calibration)))).calibrated.arm
    again = arm.inertias.held
    assert (again.joints, again.mass) == (held.joints, held.mass)
    assert np.array_equal(again.com, held.com)


@pytest.mark.slow
def test_calibration_of_another_robot_is_refused() -> None:
    model = place_model(ur10(), ("tracker",))
    calibration = Calibration(model, model, model, np.zeros((2, 6)))
    calibration.require_robot(ur10())
    longer = np.array(ur10().origins)
    longer[2, 0, 3] += 1e-4
    with pytest.raises(BadRobot, match="other nominal kinematics"):
        calibration.require_robot(ur10().with_origins(longer))
    with pytest.raises(BadRobot, match="this robot has j0"):
        calibration.require_robot(slider_arm())
    assert fingerprint(ur10()) == fingerprint(ur10().with_origins(ur10().origins + 1e-13))


@pytest.mark.parametrize(
    "data", [None, [], {"a": 1}, {"modcal_calibration": 99}, {"modcal_calibration": 1, "nominal": {}}]
)
def test_damaged_calibrations_are_refused(data: object) -> None:
    with pytest.raises(BadTable):
        from_data(data, "some.yaml")


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    made = record(9, 80)
    choice = choose_parameters(
        Model(ur10(), ("tracker",), np.eye(4)[None], se3.transform(p=[0.1, 0.1, 0.1])), views_of(made.samples)
    )
    return finalise(made.samples, ur10(), choice, Cell())


def test_a_damaged_one_is_refused(calibration: Calibration) -> None:
    data = to_data(calibration)
    rows = data["uncertainty"]["covariance"].splitlines()
    for damaged in (rows[:-1], [*rows[:-1], f"{rows[-1]} 1.0"], [*rows[:-1], "nan" + rows[-1][rows[-1].index(" ") :]]):
        data["uncertainty"]["covariance"] = "\n".join(damaged)
        with pytest.raises(BadTable, match="covariance"):
            from_data(data)
    data["uncertainty"]["covariance"] = "\n".join(["one", *rows[1:]])
    with pytest.raises(BadTable, match="damaged"):
        from_data(data)


URDF = (Path(__file__).resolve().parents[2] / "examples" / "robots" / "ur10.urdf").read_text(encoding="utf-8")
ELBOW = 2


def recorded(rng: np.random.Generator, count: int) -> Samples:
    """Exact poses; the elbow is off by something that is half a joint zero and half a curve."""
    chain = read_chain(URDF, tip="tool0")
    q = rng.uniform(-1.5, 1.5, (count, 6))
    bent = q.copy()
    bent[:, ELBOW] += 2e-3 * np.cos(0.5 * q[:, ELBOW])
    base, tool = se3.exp([1.0, 2.0, 0.3, 0.2, -0.4, 1.0]), se3.exp([0.05, 0.03, 0.12, 0.2, 0.0, 0.3])
    return samples_of(chain, q, base @ chain_forward(chain, bent) @ tool)


@pytest.mark.slow
def test_robot_description_and_kinematics_hold_the_geometry_that_is_best_alone(rng: np.random.Generator) -> None:
    chain, samples = read_chain(URDF, tip="tool0"), recorded(rng, 120)
    nominal = fit_cell(chain, samples, Cell())
    choice = choose_parameters(nominal.model, views_of(samples))
    choice = replace(choice, parameters=free_cell(choice.parameters, Cell()))
    curve = Effect("gear_harmonic", "elbow_joint", AXIS, "position:elbow_joint", Shape("sine", {"cycles": 0.5}))
    start = nominal.model.with_effects((curve.started(np.zeros(2)),))
    made = finalise(samples, chain, choice, Cell(), None, identify(start, samples, choice.parameters))
    others = recorded(rng, 60)

    def missed(T: Array) -> float:
        return float(np.sqrt(np.mean(np.sum((T[:, :3, 3] - others.reading) ** 2, axis=1))))

    beside = made.calibrated.with_effects(())
    assert missed(made.geometric.predict(others.q)) < 0.5 * missed(beside.predict(others.q))
    files = calibration_files(made, evaluate(made, others, rng), chain, URDF, page=False)
    corrected = read_chain(files["calibrated.urdf"], tip="tool0")
    model = replace(made.geometric, chain=corrected)
    assert missed(model.predict(others.q)) == pytest.approx(missed(made.geometric.predict(others.q)), rel=1e-6)
    kinematics = yaml.safe_load(files["kinematics.yaml"])["kinematics"]
    origin = joint_origins(files["calibrated.urdf"])["elbow_joint"]
    assert [kinematics["forearm"][axis] for axis in "xyz"] == pytest.approx(origin[:3, 3], abs=1e-12)

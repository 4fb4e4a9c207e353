"""What a calibration leaves behind predicts the same as the fit, to rounding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from cells import record, slider_arm, ur10

from modcal_core.calibration.model import place_model
from modcal_core.calibration.parameters import least_change
from modcal_core.calibration.store import Calibration, fingerprint, from_data, to_data
from modcal_core.effects.drivers import NominalArm
from modcal_core.errors import BadRobot, BadTable
from modcal_core.files import to_yaml
from modcal_core.loop import calibrate
from modcal_core.robots.chain import Chain
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
    calibration = calibrate(made.samples, ur10(), np.random.default_rng(0)).calibration
    again = from_data(yaml.safe_load(to_yaml(to_data(calibration))))
    q = made.samples.q
    assert np.array_equal(again.calibrated.predict(q), calibration.calibrated.predict(q))
    assert again.parameters == calibration.parameters
    assert again.robot == calibration.robot


def test_an_arm_that_is_held_behind_its_joints_survives_its_file() -> None:
    """As of two arms that look at each other."""
    chain = ur10()
    held = HeldBehind(2, 3.5, np.array([0.1, 0.2, 0.3]))
    inertias = Inertias(np.ones(6), np.zeros((6, 3)), np.zeros((6, 3, 3)), held=held)
    model = replace(place_model(chain, ("tracker",)), arm=NominalArm(chain, inertias))
    calibration = Calibration(model, model, model, np.zeros((2, 6)))
    arm = from_data(yaml.safe_load(to_yaml(to_data(calibration)))).calibrated.arm
    assert arm is not None
    assert arm.inertias is not None
    again = arm.inertias.held
    assert again is not None
    assert (again.joints, again.mass) == (held.joints, held.mass)
    assert np.array_equal(again.com, held.com)


@pytest.mark.slow
def test_calibration_of_another_robot_is_refused() -> None:
    model = calibrate(record(1, 100).samples, ur10(), np.random.default_rng(0)).calibration.nominal
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

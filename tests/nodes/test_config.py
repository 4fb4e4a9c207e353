"""Config files say only what the nodes know."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from modcal_nodes.ros.parameters import (
    ACCELERATION_LIMITS,
    ARTICULATION_ESTIMATOR,
    BOARD_DETECTOR,
    CALIBRATOR,
    CORRECTOR,
    IMPEDANCE_SETPOINT,
    RECORDER,
    SIMULATED_CELL,
    SIMULATED_FURNITURE,
    VIEWER,
)

PACKAGE = Path(__file__).resolve().parents[2] / "ros2_ws" / "src" / "modcal_nodes"
KNOWN = {
    "recorder": RECORDER,
    "board_detector": BOARD_DETECTOR,
    "calibrator": CALIBRATOR,
    "corrector": CORRECTOR,
    "articulation_estimator": ARTICULATION_ESTIMATOR,
    "impedance_setpoint": IMPEDANCE_SETPOINT,
    "acceleration_limits": ACCELERATION_LIMITS,
    "simulated_cell": SIMULATED_CELL,
    "simulated_furniture": SIMULATED_FURNITURE,
    "viewer": VIEWER,
}


@pytest.mark.parametrize("name", KNOWN)
def test_config_files_name_declared_parameters(name: str) -> None:
    stated = yaml.safe_load((PACKAGE / "config" / f"{name}.yaml").read_text())["/**"]["ros__parameters"]
    for key, value in stated.items():
        parameter = KNOWN[name][key]
        assert type(value) is type(parameter.default), key
        if parameter.low is not None and parameter.high is not None:
            assert parameter.low <= value <= parameter.high, key


def test_defaults_lie_within_their_bounds() -> None:
    for parameters in KNOWN.values():
        for name, parameter in parameters.items():
            assert parameter.description.endswith("."), name
            if parameter.low is not None and parameter.high is not None:
                assert parameter.low <= parameter.default <= parameter.high, name

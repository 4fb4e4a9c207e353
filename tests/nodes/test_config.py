"""Config and launch files say only what the nodes know."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
import yaml

from modcal_nodes.parameters import (
    ACCELERATION_LIMITS,
    ARTICULATION_ESTIMATOR,
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
    stated = yaml.safe_load((PACKAGE / "config" / f"{name}.yaml").read_text())[name]["ros__parameters"]
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


LAUNCHED = {
    "calibrate": {"recorder", "calibrator"},
    "correct": {"corrector"},
    "limits": {"acceleration_limits"},
    "articulate": {"articulation_estimator", "impedance_setpoint"},
    "view": {"viewer"},
}


@pytest.mark.parametrize("file", LAUNCHED)
def test_launch_file_starts_executables_that_exist(file: str) -> None:
    """It can only be run where launch is installed, so it is read."""
    tree = ast.parse((PACKAGE / "launch" / f"{file}.launch.py").read_text())
    keywords = [keyword for call in ast.walk(tree) if isinstance(call, ast.Call) for keyword in call.keywords]
    named = {k.value.value for k in keywords if k.arg == "executable" and isinstance(k.value, ast.Constant)}
    assert named == LAUNCHED[file]
    assert all(f"{name} = " in (PACKAGE / "setup.py").read_text() for name in named)
    assert any(isinstance(f, ast.FunctionDef) and f.name == "generate_launch_description" for f in tree.body)


@pytest.mark.parametrize("file", LAUNCHED)
def test_launch_file_sets_declared_parameters_and_config_files_that_exist(file: str) -> None:
    tree = ast.parse((PACKAGE / "launch" / f"{file}.launch.py").read_text())
    declared = {name for node in LAUNCHED[file] for name in KNOWN[node]}
    set_here = {
        key.value
        for table in ast.walk(tree)
        if isinstance(table, ast.Dict)
        for key in table.keys
        if isinstance(key, ast.Constant)
    }
    assert set_here <= declared
    texts = [c.value for c in ast.walk(tree) if isinstance(c, ast.Constant) and isinstance(c.value, str)]
    configs = [text for text in texts if text.endswith(".yaml")]
    assert len(configs) == len(LAUNCHED[file])
    assert all((PACKAGE / config.removeprefix("/")).is_file() for config in configs)

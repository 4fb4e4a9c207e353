"""Config and launch files say only what the nodes know."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
import yaml

from modcal_nodes.parameters import CALIBRATOR, RECORDER, SIMULATED_CELL

PACKAGE = Path(__file__).resolve().parents[2] / "ros2_ws" / "src" / "modcal_nodes"
KNOWN = {"recorder": RECORDER, "calibrator": CALIBRATOR, "simulated_cell": SIMULATED_CELL}


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


def test_launch_file_starts_executables_that_exist() -> None:
    """It can only be run where launch is installed, so it is read."""
    tree = ast.parse((PACKAGE / "launch" / "calibrate.launch.py").read_text())
    named = {
        keyword.value.value
        for call in ast.walk(tree)
        if isinstance(call, ast.Call)
        for keyword in call.keywords
        if keyword.arg == "executable" and isinstance(keyword.value, ast.Constant)
    }
    assert named == {"recorder", "calibrator"}
    assert all(f"{name} = " in (PACKAGE / "setup.py").read_text() for name in named)
    assert any(isinstance(f, ast.FunctionDef) and f.name == "generate_launch_description" for f in tree.body)

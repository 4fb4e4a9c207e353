"""What launch files start, and whose parameters win. ``launch`` itself cannot be run here: its adapter is read only."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import pytest
import rclpy
import yaml
from nodes.processes import fresh_domain

from modcal_core.errors import BadTable
from modcal_nodes.nodes.corrector import Corrector
from modcal_nodes.ros.launch_files import LAUNCHES, arguments, nodes
from modcal_nodes.ros.parameters import NODES

PACKAGE = Path(__file__).resolve().parents[2] / "ros2_ws" / "src" / "modcal_nodes"
EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "robots"


def chosen(launch: str, **given: str) -> dict[str, str]:
    """Every argument of a launch file as launch would hand it over."""
    values = {argument.name: argument.default for argument in arguments(launch)}
    assert set(given) <= set(values)
    return {**values, **given}


@pytest.mark.parametrize("launch", LAUNCHES)
def test_a_launch_file_starts_what_exists_with_what_it_knows(launch: str) -> None:
    setup = (PACKAGE / "setup.py").read_text()
    for node in nodes(launch, chosen(launch), PACKAGE):
        name = node["executable"]
        assert f"{name} = " in setup
        for parameters in node["parameters"]:
            if isinstance(parameters, str):
                assert Path(parameters).is_file()
            else:
                assert set(parameters) <= {*NODES[name], "use_sim_time"}
    for argument in arguments(launch):
        assert argument.about
        for place in argument.parameters:
            node_name, _, parameter = place.partition(".")
            assert parameter in NODES[node_name]
            assert node_name in LAUNCHES[launch].nodes
    names = [argument.name for argument in arguments(launch)]
    assert len(names) == len(set(names))
    assert {"namespace", "use_sim_time", "params_file", "log_level"} <= set(names)


def test_every_launch_file_is_the_adapter_and_no_more() -> None:
    files = sorted((PACKAGE / "launch").glob("*.launch.py"))
    assert [file.name.removesuffix(".launch.py") for file in files] == sorted(LAUNCHES)
    for file in files:
        tree = ast.parse(file.read_text())
        calls = [n for n in ast.walk(tree) if isinstance(n, ast.Call)]
        assert [ast.literal_eval(call.args[0]) for call in calls] == [file.name.removesuffix(".launch.py")]
        assert any(isinstance(f, ast.FunctionDef) and f.name == "generate_launch_description" for f in tree.body)


def test_arguments_become_parameters_of_their_type_and_remaps(tmp_path: Path) -> None:
    user = tmp_path / "user.yaml"
    user.write_text("/**:\n  ros__parameters:\n    tip: flange\n")
    given = chosen(
        "articulate", namespace="/left", use_sim_time="true", params_file=str(user), log_level="debug", calibrated="true",
        direction="[1, 0, 0]", joint_states="/ur/joint_states", references="/servo/references",
    )  # fmt: skip
    estimator, setpoint = nodes("articulate", given, PACKAGE)
    assert estimator["namespace"] == setpoint["namespace"] == "/left"
    assert setpoint["parameters"][-2] == str(user)
    last = setpoint["parameters"][-1]
    assert last == {"use_sim_time": True, "calibrated": True, "direction": [1.0, 0.0, 0.0]}
    assert all(isinstance(x, float) for x in last["direction"])
    assert ("joint_states", "/ur/joint_states") in estimator["remappings"]
    assert ("~/joint_references", "/servo/references") in setpoint["remappings"]
    assert ("object_status", "articulation_estimator/object_status") in setpoint["remappings"]
    assert setpoint["ros_arguments"] == ["--log-level", "debug"]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"use_sim_time": "perhaps"}, "neither true nor false"),
        ({"log_level": "loud"}, "is not a log level"),
        ({"params_file": "no/such.yaml"}, "is not a file"),
        ({"direction": "[1, 0"}, "direction"),
    ],
)
def test_an_argument_that_cannot_be_is_refused(given: dict[str, str], said: str) -> None:
    with pytest.raises(BadTable, match=said):
        nodes("articulate", chosen("articulate", **given), PACKAGE)


def test_the_demonstrations_robot_is_the_examples() -> None:
    for robot in (PACKAGE / "robots").glob("*.urdf"):
        assert robot.read_bytes() == (EXAMPLES / robot.name).read_bytes()


@pytest.mark.dds
@pytest.mark.parametrize("key", ["/**", "corrector", "/arm/corrector", "/arm/*", "/**/corrector"])
@pytest.mark.parametrize("first", [[], ["-p", "use_sim_time:=true"]])
def test_the_users_file_wins_over_the_packages(key: str, first: list[str], tmp_path: Path) -> None:
    """In a namespace, under every way to name the node, whether or not use_sim_time comes first."""
    user = tmp_path / "user.yaml"
    user.write_text(yaml.safe_dump({key: {"ros__parameters": {"rate_hz": 7.0}}}))
    # a name without a slash is the node's in no namespace
    namespace = [] if key == "corrector" else ["-r", "__ns:=/arm"]
    shipped = PACKAGE / "config" / "corrector.yaml"
    stated: dict[str, Any] = yaml.safe_load(shipped.read_text())["/**"]["ros__parameters"]
    assert stated["rate_hz"] != 7.0
    files = ["--params-file", str(shipped), "--params-file", str(user)]
    rclpy.init(args=["--ros-args", *first, *files, *namespace], domain_id=fresh_domain())
    try:
        node = Corrector()
        assert node.get_parameter("rate_hz").value == 7.0
        assert node.get_parameter("horizon_s").value == stated.get("horizon_s", NODES["corrector"]["horizon_s"].default)
        assert node.get_parameter("use_sim_time").value == bool(first)
        node.destroy_node()
    finally:
        rclpy.try_shutdown()

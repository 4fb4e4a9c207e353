"""What launch files and config files state, what RViz and Foxglove show, and what a node imports."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import rclpy
import yaml
from nodes.processes import fresh_domain
from nodes.test_graph import graph, listed

from modcal_core.errors import BadTable
from modcal_nodes import viewing
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
@pytest.mark.parametrize(
    ("key", "first"),
    [("/**", True), ("corrector", False), ("/arm/corrector", True), ("/arm/*", False), ("/**/corrector", True)],
)
def test_the_users_file_wins_over_the_packages(key: str, first: bool, tmp_path: Path) -> None:
    """In a namespace, under every way to name the node, whether or not use_sim_time comes first."""
    user = tmp_path / "user.yaml"
    user.write_text(yaml.safe_dump({key: {"ros__parameters": {"rate_hz": 7.0}}}))
    # a name without a slash is the node's in no namespace
    namespace = [] if key == "corrector" else ["-r", "__ns:=/arm"]
    shipped = PACKAGE / "config" / "corrector.yaml"
    stated: dict[str, Any] = yaml.safe_load(shipped.read_text())["/**"]["ros__parameters"]
    assert stated["rate_hz"] != 7.0
    files = ["--params-file", str(shipped), "--params-file", str(user)]
    rclpy.init(
        args=["--ros-args", *(["-p", "use_sim_time:=true"] if first else []), *files, *namespace],
        domain_id=fresh_domain(),
    )
    try:
        node = Corrector()
        assert node.get_parameter("rate_hz").value == 7.0
        assert node.get_parameter("horizon_s").value == stated.get("horizon_s", NODES["corrector"]["horizon_s"].default)
        assert node.get_parameter("use_sim_time").value == first
        node.destroy_node()
    finally:
        rclpy.try_shutdown()


@pytest.mark.parametrize("name", sorted(file.stem for file in (PACKAGE / "config").glob("*.yaml")))
def test_config_files_name_declared_parameters(name: str) -> None:
    stated = yaml.safe_load((PACKAGE / "config" / f"{name}.yaml").read_text())["/**"]["ros__parameters"]
    for key, value in stated.items():
        parameter = NODES[name][key]
        assert type(value) is type(parameter.default), key
        if parameter.low is not None and parameter.high is not None:
            assert parameter.low <= value <= parameter.high, key


def test_defaults_lie_within_their_bounds() -> None:
    for parameters in NODES.values():
        for name, parameter in parameters.items():
            assert parameter.description.endswith("."), name
            if parameter.low is not None and parameter.high is not None:
                assert parameter.low <= parameter.default <= parameter.high, name


CONFIG = Path(__file__).resolve().parents[2] / "ros2_ws" / "src" / "modcal_nodes" / "config"
SHOWS = {
    "rviz_default_plugins/MarkerArray": "visualization_msgs/msg/MarkerArray",
    "rviz_default_plugins/Pose": "geometry_msgs/msg/PoseStamped",
    "rviz_default_plugins/PoseWithCovariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "rviz_default_plugins/RobotModel": "std_msgs/msg/String",
}
IN_3D = {"std_msgs/msg/String", *SHOWS.values()}
SPACES = {
    "/viewer/residuals": {viewing.CALIBRATED, viewing.NOMINAL, viewing.SCALE},
    "/viewer/stations": {viewing.RECORDED, viewing.FITTING, viewing.REJECTED, viewing.WAITING},
    "/viewer/axes": {viewing.CALIBRATED, viewing.NOMINAL},
    "/viewer/uncertainty": {viewing.PRESENT, viewing.STATIONS},
    "/articulation_estimator/object_axis": {"object"},
}


@pytest.fixture(scope="module")
def published() -> dict[str, str]:
    """Types of all topics that our nodes publish, by name; the page is compared with the running nodes."""
    return {
        f"/{name.replace('~', node)}": kind
        for node in graph.executables()
        for opened in listed(node)
        for what, name, kind in opened
        if what == "publishes"
    }


def rviz() -> dict[str, Any]:
    return yaml.safe_load((CONFIG / "modcal.rviz").read_text())["Visualization Manager"]


def foxglove() -> dict[str, Any]:
    return json.loads((CONFIG / "modcal_foxglove.json").read_text())


@pytest.mark.slow
def test_rviz_shows_what_is_published(published: dict[str, str]) -> None:
    shown = set()
    for display in rviz()["Displays"]:
        topic = display.get("Topic") or display.get("Description Topic")
        if topic is None:
            assert display["Class"] in ("rviz_default_plugins/Grid", "rviz_default_plugins/TF")
            continue
        assert published[topic["Value"]] == SHOWS[display["Class"]], topic["Value"]
        shown.add(topic["Value"])
        if "Namespaces" in display:
            assert set(display["Namespaces"]) == SPACES[topic["Value"]]
    assert set(SPACES) <= shown
    assert rviz()["Global Options"]["Fixed Frame"] == "base_link"


def test_rviz_asks_for_what_is_latched(published: dict[str, str]) -> None:
    """A latched topic that is asked for as volatile shows nothing until something changes."""
    durability = {d["Topic"]["Value"]: d["Topic"]["Durability Policy"] for d in rviz()["Displays"] if "Topic" in d}
    for topic, asked in durability.items():
        latched = topic in ("/viewer/residuals", "/viewer/stations")
        assert asked == ("Transient Local" if latched else "Volatile"), topic
        assert topic in published


def test_foxglove_shows_what_is_published(published: dict[str, str]) -> None:
    panels = foxglove()["configById"]
    topics = panels["3D!modcal"]["topics"]
    assert set(SPACES) <= set(topics)
    for topic, settings in topics.items():
        assert published[topic] in IN_3D, topic
        if "namespaces" in settings:
            assert set(settings["namespaces"]) == SPACES[topic]
    paths = [p["value"] for panel in panels.values() for p in panel.get("paths", ())]
    paths += [panel["topicPath"] for panel in panels.values() if "topicPath" in panel]
    assert len(paths) >= 7
    for path in paths:
        topic, _, rest = path.partition(".")
        _require_field(published[topic], rest)
    summaries = [panel for panel in panels.values() if "topicToRender" in panel]
    assert [published[panel["topicToRender"]] for panel in summaries] == ["diagnostic_msgs/msg/DiagnosticArray"]


def _require_field(kind: str, path: str) -> None:
    """A message of this type has what the path names."""
    for name in filter(None, re.sub(r"\[\d+\]", "", path).split(".")):
        package, _, message = kind.partition("/msg/")
        fields = getattr(__import__(f"{package}.msg", fromlist=[message]), message).get_fields_and_field_types()
        assert name in fields, (kind, name)
        kind = fields[name].removeprefix("sequence<").removesuffix(">").replace("/", "/msg/")


def test_every_panel_is_in_the_layout() -> None:
    data = foxglove()

    def leaves(part: Any) -> list[str]:
        return [part] if isinstance(part, str) else [*leaves(part["first"]), *leaves(part["second"])]

    assert sorted(leaves(data["layout"])) == sorted(data["configById"])


DRAWING = {"matplotlib", "jinja2"}
# which a farm that builds packages has not
FROM_PIP = {"mcap", "rosbags", "zstandard", "lz4", "mujoco", "fpdf", "pyarrow"}
COMPUTING = {"scipy.linalg", "scipy.special", "scipy.optimize"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("node", "unwanted"),
    [
        ("corrector", DRAWING | COMPUTING | FROM_PIP),
        ("simulated_cell", DRAWING | COMPUTING | {"ssl", "mcap"}),
        ("calibrator", DRAWING | FROM_PIP | {"scipy.stats"}),
        *((node, FROM_PIP) for node in ("acceleration_limits", "articulation_estimator", "impedance_setpoint")),
        ("station_runner", DRAWING | {"scipy.stats"}),
    ],
)
def test_a_node_imports_what_it_needs(node: str, unwanted: set[str]) -> None:
    code = f"import sys, modcal_nodes.nodes.{node}; print(*sorted(set(sys.modules) & {unwanted!r}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []

"""What the RViz config and the Foxglove layout show is what nodes publish, asked of the nodes themselves."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
import yaml
from cli.recordings import URDF
from nodes.processes import fresh_domain
from rclpy.node import Node

from modcal_nodes.calibrating.publishers import Publishers
from modcal_nodes.nodes.articulation_estimator import ArticulationEstimator
from modcal_nodes.nodes.corrector import Corrector
from modcal_nodes.nodes.simulated_cell import SimulatedCell
from modcal_nodes.nodes.viewer import Viewer
from modcal_nodes.ros.subscriptions import Health
from modcal_nodes.viewing import drawing

CONFIG = Path(__file__).resolve().parents[2] / "ros2_ws" / "src" / "modcal_nodes" / "config"
SHOWS = {
    "rviz_default_plugins/MarkerArray": "visualization_msgs/msg/MarkerArray",
    "rviz_default_plugins/Pose": "geometry_msgs/msg/PoseStamped",
    "rviz_default_plugins/PoseWithCovariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "rviz_default_plugins/RobotModel": "std_msgs/msg/String",
}
IN_3D = {"std_msgs/msg/String", *SHOWS.values()}
SPACES = {
    "/viewer/residuals": {drawing.CALIBRATED, drawing.NOMINAL, drawing.SCALE},
    "/viewer/stations": {drawing.RECORDED, drawing.FITTING, drawing.REJECTED, drawing.WAITING},
    "/viewer/axes": {drawing.CALIBRATED, drawing.NOMINAL},
    "/viewer/uncertainty": {drawing.PRESENT, drawing.STATIONS},
    "/articulation_estimator/object_axis": {"object"},
}


@pytest.fixture(scope="module")
def published() -> Iterator[dict[str, str]]:
    """Types of all topics that our nodes publish, by name."""
    rclpy.init(args=["--ros-args", "-p", f"urdf:={URDF}"], domain_id=fresh_domain())
    calibrator = Node("calibrator")
    Publishers(calibrator)
    Health(calibrator, lambda: [])
    nodes = [calibrator, ArticulationEstimator(), Corrector(), SimulatedCell(), Viewer()]
    yield {
        topic: types[0]
        for node in nodes
        for topic, types in node.get_publisher_names_and_types_by_node(node.get_name(), "/")
    }
    for node in nodes:
        if hasattr(node, "close"):
            node.close()
        node.destroy_node()
    rclpy.try_shutdown()


def rviz() -> dict[str, Any]:
    return yaml.safe_load((CONFIG / "modcal.rviz").read_text())["Visualization Manager"]


def foxglove() -> dict[str, Any]:
    return json.loads((CONFIG / "modcal_foxglove.json").read_text())


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


def test_both_are_installed(install: Path) -> None:
    for name in ("modcal.rviz", "modcal_foxglove.json"):
        assert (install / "modcal_nodes" / "share" / "modcal_nodes" / "config" / name).read_text()

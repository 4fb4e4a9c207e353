"""The page of topics, services and actions: every node is started in this process, and asked what it has opened.

A topic that depends on a parameter is found by starting the node once more with that parameter. No node hears another:
discovery is switched off.
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import chdir, contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path

import rclpy
from markup import code, table
from rclpy.action import ActionClient, ActionServer
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "ros2_ws" / "src" / "modcal_nodes"
URDF = ROOT / "examples" / "robots" / "ur10.urdf"
SPACE = "/somewhere"
# What each node needs to start, and parameters that decide which topics there are.
_TRAJECTORY = Path(tempfile.mkdtemp()) / "trajectory.yaml"
_TRAJECTORY.write_text("{joint_names: [a], points: [{positions: [0.0], time_from_start: {sec: 0, nanosec: 0}}]}")
_TARGET = _TRAJECTORY.with_name("target.yaml")
_TARGET.write_text("{modcal_target: 1, type: chessboard, columns: 7, rows: 4, square_m: 0.03}")
NEEDED = {
    "board_detector": {"target": str(_TARGET)},
    "simulated_cell": {"urdf": str(URDF)},
    "simulated_furniture": {"urdf": str(URDF)},
    "door_demo": {"start": "false"},
    "trajectory_sender": {"trajectory": str(_TRAJECTORY)},
}
DECIDING = {
    "calibrator": [("target", str(_TARGET))],
    "articulation_estimator": [("input", topic) for topic in ("tool_pose", "tracker/pose", "tracker/point")],
    "simulated_cell": [("measurement", "point"), ("publish_clock", "true")],
    "simulated_furniture": [("publish_clock", "true")],
    "station_runner": [("measurement", "point")],
}
EVERY_NODE = {"/rosout", "/parameter_events"}
EVERY_NODES_SERVICES = ("rcl_interfaces", "type_description_interfaces")
KINDS = ("subscribes to", "publishes", "serves", "performs", "asks for")

INTRODUCTION = """# Topics, services and actions

Names are relative to the node's namespace; `~/` stands for the node's own name. *Latched* is transient local: whoever
comes later gets the last message. The number is how many messages are kept. Where a publisher offers less than is
asked for (best effort for reliable, not latched for latched), the nodes take what there is; the simulators do not.
What the messages hold is in [nodes.md](../nodes.md); a node *performs* its actions and *asks for* those of others.
Every node has `/rosout` and the services of parameters, log levels and type descriptions besides, and hears `/clock`
with `use_sim_time`."""
RECORDS = """Hears what its [parameter](parameters.md#recorder) `topics` names, whatever the type, with the QoS that its
publishers offer."""

# tf2_msgs is not there from wheels, so a node that is started here does not open them
FRAMES = {
    node: table(["frames", "type", ""], [[code(name), "tf2_msgs/TFMessage", said] for name, said in rows])
    for node, rows in {
        "calibrator": [
            ("/tf_static", "published and subscribed to when `publish_tf` is `true`"),
            ("/tf", "subscribed to then"),
        ],
        "corrector": [
            ("/tf", "published and subscribed to when `publish_tf` is `true`"),
            ("/tf_static", "subscribed to then"),
        ],
    }.items()
}


@dataclass(frozen=True)
class Opened:
    """A topic, service or action of a node. kind: one of KINDS. qos: of topics, else empty."""

    kind: str
    name: str
    type: str
    qos: str


def executables() -> list[str]:
    """Names of the package's nodes, in the order of its setup.py: each is in a module of its name."""
    return re.findall(r"(\w+) = \{PACKAGE\}\.nodes\.\1:\w+\.main", (PACKAGE / "setup.py").read_text(encoding="utf-8"))


def page() -> str:
    """Text of the page."""
    parts = [INTRODUCTION]
    for node in executables():
        parts += [f"## {node}", *_sections(node)]
    return "\n\n".join(parts) + "\n"


def _asked(node: str) -> list[dict[str, str]]:
    """Parameters with which a node is started: none, and each of those that decide."""
    return [{}, *({name: value} for name, value in DECIDING.get(node, []))]


@cache
def _runs(node: str) -> list[set[Opened]]:
    """What a node opens with each of these."""
    return [set(_opened(node, NEEDED.get(node, {}) | more)) for more in _asked(node)]


def opened(node: str) -> set[Opened]:
    """All that a node opens, whatever its parameters."""
    return set().union(*_runs(node))


def _sections(node: str) -> Iterator[str]:
    asked, runs = _asked(node), _runs(node)
    if node == "recorder":
        yield RECORDS
    if node in FRAMES:
        yield FRAMES[node]
    for kind in KINDS:
        of_kind = sorted({o for run in runs for o in run if o.kind == kind}, key=lambda o: (o.name, o.type))
        rows = [[code(o.name), o.type, o.qos, _when(o, runs, asked)] for o in of_kind]
        width = max((2 + bool(row[2]) + bool(row[3]) for row in rows), default=0)
        if rows:
            yield table([kind, "type", "QoS", ""][:width], [row[:width] for row in rows])


def _when(opened: Opened, runs: list[set[Opened]], asked: list[dict[str, str]]) -> str:
    """On which parameter a topic depends: it is there at the defaults and not otherwise, or the other way round."""
    there = opened in runs[0]
    words: dict[str, list[str]] = {}
    for run, more in zip(runs[1:], asked[1:], strict=True):
        if (opened in run) != there:
            for name, value in more.items():
                words.setdefault(name, []).append(value)
    # a file that is there for this only has no name to tell
    said = {name: ["set" if Path(v).is_absolute() else f"`{v}`" for v in values] for name, values in words.items()}
    told = [f"`{name}` is " + " or ".join(values) for name, values in said.items()]
    return (("unless " if there else "when ") + " or ".join(told)) if told else ""


def _opened(name: str, parameters: dict[str, str]) -> list[Opened]:
    """What a node with these parameters opens, once it is configured if it has to be."""
    with _started(name, parameters) as node:
        if isinstance(node, LifecycleNode) and node._state_machine.current_state[1] == "unconfigured":
            node.trigger_configure()
        heard = [Opened("subscribes to", _short(s.topic_name, name), _type(s.msg_type), _qos(s.qos_profile))
                 for s in node.subscriptions if s.topic_name not in EVERY_NODE]  # fmt: skip
        said = [Opened("publishes", _short(p.topic_name, name), _type(p.msg_type), _qos(p.qos_profile))
                for p in node.publishers if p.topic_name not in EVERY_NODE]  # fmt: skip
        served = [Opened("serves", _short(s.service_name, name), _type(s.srv_type), "")
                  for s in node.services if not s.srv_type.__module__.startswith(EVERY_NODES_SERVICES)]  # fmt: skip
        return [*heard, *said, *served, *_actions(node)]


def _actions(node: Node) -> Iterator[Opened]:
    """Of a server rclpy does not keep the name, which is that of the type in small letters here."""
    for waitable in node.waitables:
        if isinstance(waitable, ActionServer):
            kind = waitable.action_type
            yield Opened("performs", f"~/{kind.__name__.lower()}", _type(kind), "")
        elif isinstance(waitable, ActionClient):
            yield Opened("asks for", waitable._action_name, _type(waitable._action_type), "")


@contextmanager
def _started(name: str, parameters: dict[str, str]) -> Iterator[Node]:
    """The node of an executable, in a folder of its own, heard by nobody."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "OFF"
    module = import_module(f"modcal_nodes.nodes.{name}")
    kinds = [v for v in vars(module).values() if isinstance(v, type) and issubclass(v, Node)]
    (kind,) = [k for k in kinds if k.__module__ == module.__name__]
    settings = [word for key, value in parameters.items() for word in ("-p", f"{key}:={value}")]
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        rclpy.init(args=["--ros-args", "--log-level", "FATAL", "-r", f"__ns:={SPACE}", *settings])
        node = kind()
        try:
            yield node
        finally:
            node.close()
            node.destroy_node()
            rclpy.try_shutdown()


def _short(name: str, node: str) -> str:
    inside = name.removeprefix(f"{SPACE}/")
    return "~/" + inside.removeprefix(f"{node}/") if inside.startswith(f"{node}/") else inside


def _type(kind: type) -> str:
    return ".".join(kind.__module__.split(".")[:2]).replace(".", "/") + f"/{kind.__name__}"


def _qos(profile: QoSProfile) -> str:
    reliable = profile.reliability == ReliabilityPolicy.RELIABLE
    latched = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    return f"{'latched, ' if latched else ''}{'reliable' if reliable else 'best effort'}, {profile.depth}"

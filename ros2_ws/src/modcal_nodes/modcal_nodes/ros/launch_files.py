"""What the launch files start, as plain values; ``described`` is the only part that needs ``launch`` to be installed.

Parameters stand in the order in which later ones win: the package's config file, what a demonstration always sets, the
user's params_file, and the launch arguments that were given. The package's files say ``/**`` and come first, so that
nothing of theirs is more specific, or later, than what the user says.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from modcal_core.errors import BadTable
from modcal_nodes.ros.parameters import NODES, Parameter

_LEVELS = ("debug", "info", "warn", "error", "fatal")
_SIMULATED = Parameter(False, "Whether /clock is used.")  # of every node


@dataclass(frozen=True)
class Argument:
    """A launch argument. parameters: node.parameter that it sets where it is not empty. remaps: node -> topics."""

    name: str
    about: str
    default: str = ""
    parameters: tuple[str, ...] = ()
    remaps: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Launch:
    """A launch file: its nodes, its own arguments, what is always set, and what is always remapped, by node."""

    nodes: tuple[str, ...]
    arguments: tuple[Argument, ...]
    fixed: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    remaps: Mapping[str, tuple[tuple[str, str], ...]] = field(default_factory=dict)


def _sets(name: str, about: str, *nodes: str, parameter: str = "", default: str = "") -> Argument:
    return Argument(name, about, default, tuple(f"{node}.{parameter or name}" for node in nodes))


def _topic(name: str, topic: str, about: str, *nodes: str, default: str = "") -> Argument:
    return Argument(name, f"{about}; empty: {topic}", default, (), tuple((node, topic) for node in nodes))


_COMMON = (
    Argument("namespace", "namespace of every node and relative topic"),
    Argument("use_sim_time", "use /clock: true or false; empty: as in params_file"),
    Argument("params_file", "YAML file of parameters, under /** or a node's name; wins over the package's own"),
    Argument("log_level", "debug, info, warn, error or fatal", "info"),
)
_HEARD = ("joint_states", "robot_description", "tracker/pose", "tracker/point")


def _heard(*nodes: str, topics: tuple[str, ...] = _HEARD) -> tuple[Argument, ...]:
    return tuple(_topic(t.replace("/", "_"), t, f"topic that {t} is received on", *nodes) for t in topics)


def _arm(*nodes: str) -> tuple[Argument, ...]:
    return (
        _sets("base", "link where the arm begins; empty: the root link", *nodes),
        _sets("tip", "link where the arm ends; empty: the link behind most published joints", *nodes),
    )


_OBJECT = tuple((f"object_{what}", f"articulation_estimator/object_{what}") for what in ("description", "status"))
_PULL = ("articulation_estimator", "impedance_setpoint")
_JOINTS = _HEARD[:2]

LAUNCHES: dict[str, Launch] = {
    "calibrate": Launch(
        ("recorder", "calibrator"),
        (
            *_arm("calibrator"),
            _sets("out", "folder that every result is written to", "calibrator"),
            _sets("state", "folder where the trusted model and the stations are kept", "calibrator"),
            _sets("bag", "folder of the bag; must not exist; empty: modcal_ and the time", "recorder", parameter="out"),
            *_heard("calibrator"),
        ),
    ),
    "correct": Launch(
        ("corrector",),
        (
            _sets("calibration", "folder or file of a calibration; empty: the calibrator's topic", "corrector"),
            _sets("target", "frame of the poses: tip or tool", "corrector"),
            _sets("stream", "whether every desired pose is a setpoint: true or false", "corrector"),
            # on purpose not the controller's own topic: an arm moves only where somebody has said so
            _topic("command", "~/joint_trajectory", "topic that commands are sent to", "corrector"),
            *_heard("corrector", topics=_JOINTS),
        ),
        remaps={"corrector": (("calibration", "calibrator/calibration"),)},
    ),
    "limits": Launch(
        ("acceleration_limits",),
        (
            *_arm("acceleration_limits"),
            _sets("payload_kg", "mass that the arm carries [kg]", "acceleration_limits"),
            *_heard("acceleration_limits", topics=_JOINTS),
        ),
    ),
    "articulate": Launch(
        _PULL,
        (
            *_arm(*_PULL),
            _sets("mode", "admittance or expected", "impedance_setpoint"),
            _sets("calibrated", "whether the tool is where the corrector says: true or false", "impedance_setpoint"),
            _sets("direction", "assumed direction of the pull in the tool frame: [x, y, z]", "impedance_setpoint"),
            # on purpose not a controller's own topics: an arm moves only where somebody has said so
            _topic("pose", "~/target_pose", "topic that poses are sent to", "impedance_setpoint"),
            _topic("references", "~/joint_references", "topic that joint references are sent to", "impedance_setpoint"),
            _topic("trajectory", "~/joint_trajectory", "topic that trajectories are sent to", "impedance_setpoint"),
            *_heard(*_PULL, topics=_JOINTS),
            *_heard(*_PULL, topics=("wrench",)),
        ),
        {"impedance_setpoint": {"autostart": True}},
        {"impedance_setpoint": (*_OBJECT, ("tool_pose", "corrector/pose"))},
    ),
    "view": Launch(
        ("viewer",),
        (*_arm("viewer"), _sets("arrow_scale", "magnification of errors", "viewer"), *_heard("viewer")),
    ),
    "cell": Launch(
        ("simulated_cell",),
        (
            *_arm("simulated_cell"),
            _sets("urdf", "URDF file of the nominal arm; empty: the package's Panda", "simulated_cell"),
            _sets("seed", "seed of the true arm, the tracker's place and the noise", "simulated_cell"),
            _sets("measurement", "pose or point", "simulated_cell"),
            _sets("stations", "random postures to visit; 0: wait for joint_trajectory", "simulated_cell"),
        ),
        {"simulated_cell": {"urdf": "robots/panda.urdf"}},
    ),
    "door_demo": Launch(
        ("simulated_furniture", *_PULL, "door_demo"),
        (
            _sets("kind", "door or drawer", "simulated_furniture", default="door"),
            _sets("seed", "seed of the object, its place and the noise", "simulated_furniture", default="0"),
            _sets("out", "folder of the page about what was learned; empty: none", "door_demo"),
        ),
        {
            "simulated_furniture": {"urdf": "robots/panda.urdf"},
            "impedance_setpoint": {"autostart": True},
            "door_demo": {"start": False},
        },
        {"impedance_setpoint": (*_OBJECT, ("~/joint_references", "joint_references"))},
    ),
}


def arguments(launch: str) -> tuple[Argument, ...]:
    """Every argument of a launch file, the common ones last."""
    return (*LAUNCHES[launch].arguments, *_COMMON)


def nodes(launch: str, chosen: Mapping[str, str], share: Path) -> list[dict[str, Any]]:
    """The keywords of launch_ros' Node for each node of a launch file, given every argument as text.

    share: the package's share folder. Raises BadTable for an argument that cannot be.
    """
    plan, files = LAUNCHES[launch], [chosen["params_file"]] if chosen["params_file"] else []
    if chosen["log_level"] not in _LEVELS:
        raise BadTable(f"log_level:={chosen['log_level']}", "is not a log level", f"use {', '.join(_LEVELS)}")
    if files and not Path(files[0]).expanduser().is_file():
        raise BadTable(f"params_file:={files[0]}", "is not a file", "give a YAML file")
    out = []
    for node in plan.nodes:
        given: dict[str, Any] = {}
        if chosen["use_sim_time"]:
            given["use_sim_time"] = _SIMULATED.parsed("use_sim_time:=", chosen["use_sim_time"])
        for argument in plan.arguments:
            for place in argument.parameters:
                who, _, name = place.partition(".")
                if who == node and chosen[argument.name]:
                    given[name] = NODES[node][name].parsed(f"{argument.name}:=", chosen[argument.name])
        remaps = [(topic, chosen[a.name]) for a in plan.arguments for who, topic in a.remaps if who == node]
        config = share / "config" / f"{node}.yaml"
        fixed = {k: str(share / v) if k == "urdf" else v for k, v in plan.fixed.get(node, {}).items()}
        out.append(
            {
                "package": "modcal_nodes",
                "executable": node,
                "name": node,
                "namespace": chosen["namespace"],
                "output": "screen",
                "parameters": [
                    *([str(config)] if config.is_file() else []),
                    *([fixed] if fixed else []),
                    *(str(Path(f).expanduser()) for f in files),
                    *([given] if given else []),
                ],
                "remappings": [*plan.remaps.get(node, ()), *((old, new) for old, new in remaps if new)],
                "ros_arguments": ["--log-level", chosen["log_level"]],
            }
        )
    return out


def described(launch: str) -> Any:
    """The LaunchDescription of a launch file. Needs launch and launch_ros, which come with ROS and not from wheels."""
    from ament_index_python.packages import get_package_share_directory
    from launch import LaunchDescription
    from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
    from launch.substitutions import LaunchConfiguration
    from launch_ros.actions import LifecycleNode, Node

    def start(context: Any) -> list[Any]:
        chosen = {a.name: LaunchConfiguration(a.name).perform(context) for a in arguments(launch)}
        share = Path(get_package_share_directory("modcal_nodes"))
        made = []
        for keywords in nodes(launch, chosen, share):
            kind = LifecycleNode if keywords["executable"] == "impedance_setpoint" else Node
            ends = {"on_exit": Shutdown()} if keywords["executable"] == "door_demo" else {}
            made.append(kind(**keywords, **ends))
        return made

    declared = [DeclareLaunchArgument(a.name, default_value=a.default, description=a.about) for a in arguments(launch)]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])

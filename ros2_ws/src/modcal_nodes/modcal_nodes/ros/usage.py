"""What ``--help`` says of an executable, and what is said of arguments that none of them has."""

from __future__ import annotations

import inspect
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rclpy.utilities import remove_ros_args

from modcal_nodes.ros.parameter import Parameter
from modcal_nodes.ros.parameters import NODES

_WIDTH = 120
_ROS = (
    "  --ros-args -p NAME:=VALUE          a parameter",
    "  --ros-args --params-file FILE      parameters from a file",
    "  --ros-args -r FROM:=TO             another name for a topic or service; __ns:=/arm puts all in a namespace",
    "  --ros-args --log-level LEVEL       debug, info, warn, error or fatal",
)


def answered(make: Callable[[], Any], arguments: Sequence[str] | None = None) -> int | None:
    """The exit code, if the arguments ask for help or are none that a node has; None: the node is to be started."""
    words = list(sys.argv if arguments is None else arguments)
    name = Path(words[0]).name if words else ""
    if any(word in ("-h", "--help") for word in words[1:]):
        try:
            print(help_text(name, make), flush=True)
        except BrokenPipeError:  # `calibrator --help | head`: the interpreter's last flush must not complain either
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    try:
        own = remove_ros_args(words)[1:]
    except RuntimeError as error:  # rcl's own errors have no public name
        print(f"modcal: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    if own:
        print(f"modcal: {own[0]}: is not an argument of {name}: see {name} --help", file=sys.stderr)
        return 2
    return None


def help_text(name: str, make: Callable[[], Any]) -> str:
    """Usage, what the node does, and its parameters with defaults."""
    about = inspect.cleandoc(inspect.getdoc(make) or "").splitlines()[:1]
    lines = [f"usage: ros2 run modcal_nodes {name} [--ros-args ...]", "", *about, "", *_ROS]
    if parameters := NODES.get(name):
        lines += ["", "Parameters (those marked * may be changed while it runs):"]
        lines += [line for key, parameter in parameters.items() for line in _told(key, parameter)]
    lines += [
        "",
        "Exit code 0: stopped on request. 2: unusable parameters, files or disk, one line on stderr. 1: a fault.",
    ]
    return "\n".join(lines)


def _told(name: str, parameter: Parameter) -> list[str]:
    default = parameter.default if parameter.default != "" else '""'
    bounds = "" if parameter.low is None else f", {parameter.low:g} to {parameter.high:g}"
    star = "*" if parameter.live else " "
    return [f" {star}{name} ({default}{bounds})", f"      {parameter.description}"[:_WIDTH]]

"""Bounds of accelerations beside a running arm: ``ros2 launch modcal_nodes limits.launch.py payload_kg:=3.0``."""

from typing import Any

from modcal_nodes.ros.launch_files import described


def generate_launch_description() -> Any:
    """Nodes and arguments as modcal_nodes/ros/launch_files.py lists them; ``--show-args`` tells of each."""
    return described("limits")

"""The simulated cell: ``ros2 launch modcal_nodes cell.launch.py stations:=60``; without a urdf, a Panda."""

from typing import Any

from modcal_nodes.ros.launch_files import described


def generate_launch_description() -> Any:
    """Nodes and arguments as modcal_nodes/ros/launch_files.py lists them; ``--show-args`` tells of each."""
    return described("cell")

"""A simulated door that is opened, by a Panda: ``ros2 launch modcal_nodes door_demo.launch.py kind:=drawer``."""

from typing import Any

from modcal_nodes.ros.launch_files import described


def generate_launch_description() -> Any:
    """Nodes and arguments as modcal_nodes/ros/launch_files.py lists them; ``--show-args`` tells of each."""
    return described("door_demo")

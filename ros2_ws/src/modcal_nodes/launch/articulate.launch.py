"""Learning how something opens, and opening it: ``ros2 launch modcal_nodes articulate.launch.py mode:=admittance``.

The setpoint node activates itself; it pulls when its service ~/pull is called, and sends nothing before.
"""

from typing import Any

from modcal_nodes.ros.launch_files import described


def generate_launch_description() -> Any:
    """Nodes and arguments as modcal_nodes/ros/launch_files.py lists them; ``--show-args`` tells of each."""
    return described("articulate")

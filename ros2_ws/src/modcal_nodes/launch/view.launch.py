"""The live view beside a cell: ``ros2 launch modcal_nodes view.launch.py arrow_scale:=300.0``.

Then ``rviz2 -d $(ros2 pkg prefix --share modcal_nodes)/config/modcal.rviz``, or modcal_foxglove.json in Foxglove.
"""

from typing import Any

from modcal_nodes.ros.launch_files import described


def generate_launch_description() -> Any:
    """Nodes and arguments as modcal_nodes/ros/launch_files.py lists them; ``--show-args`` tells of each."""
    return described("view")

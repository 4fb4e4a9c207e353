"""A corrector before a controller: ``ros2 launch modcal_nodes correct.launch.py calibration:=modcal_calibration``.

Without a calibration it takes the one that a calibrator in the same namespace publishes.
"""

from typing import Any

from modcal_nodes.ros.launch_files import described


def generate_launch_description() -> Any:
    """Nodes and arguments as modcal_nodes/ros/launch_files.py lists them; ``--show-args`` tells of each."""
    return described("correct")

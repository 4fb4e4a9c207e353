"""Flange poses in place of joints: an arm of three sliding and three turning joints that stands in every pose exactly.

Where only the controller's poses are known, its arm cannot be calibrated, but camera and target can be placed.
"""

from __future__ import annotations

import numpy as np

from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain

_NAMES = ("flange_x", "flange_y", "flange_z", "flange_rz", "flange_ry", "flange_rx")
# of its joints
_AXES = ((1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 1), (0, 1, 0), (1, 0, 0))


def flange_arm() -> Chain:
    """The arm whose joints are position and roll, pitch, yaw of its tip."""
    turning = [False] * 3 + [True] * 3
    limits = [np.inf] * 6
    origins = [np.eye(4)] * 7
    return Chain.build(_NAMES, origins, _AXES, turning, [-x for x in limits], limits, "base", "flange")


def flange_joints(T_base_tip: Array) -> Array:
    """Joints (N, 6) [m, rad] at which :func:`flange_arm` has its tip at these poses (N, 4, 4)."""
    rpy = so3.to_rpy(T_base_tip[:, :3, :3])
    return np.concatenate([T_base_tip[:, :3, 3], rpy[:, ::-1]], axis=1)

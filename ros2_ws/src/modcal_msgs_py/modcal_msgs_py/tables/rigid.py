"""The pose of several targets on one tool."""

from __future__ import annotations

import numpy as np

from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array

_ROUNDS = 3  # of the mean shape


def rigid_poses(points: Array) -> tuple[Array, Array]:
    """(poses (m, 4, 4), mean shape (k, 3)) of targets (m, k, 3) on one body, whose frame sits in their centre.

    Their mean shape moved onto every row by a rotation and a shift (Arun, Huang and Blostein 1987).
    """
    centre = points.mean(axis=1)
    spread = points - centre[:, None]
    shape = spread[0]
    for _ in range(_ROUNDS):
        R = so3.nearest_rotation(np.swapaxes(spread, 1, 2) @ shape)
        shape = np.mean(spread @ R, axis=0)  # rows are points: R turns the shape onto the row, its transpose back
    return se3.transform(so3.nearest_rotation(np.swapaxes(spread, 1, 2) @ shape), centre), shape

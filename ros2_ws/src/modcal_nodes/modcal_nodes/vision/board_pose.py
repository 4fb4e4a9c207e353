"""Where the target is in one image, with a covariance that knows the corners' noise, and its twin."""

from __future__ import annotations

import numpy as np

from modcal_core.camera.corners import POSE, SHAPE, CornerTable, corner_rows, grams
from modcal_core.camera.lens import Lens
from modcal_core.camera.pnp import board_poses
from modcal_core.camera.target import PrintedTarget
from modcal_core.camera.views import BoardView
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array

_TWIN = 9.0  # of the sum of squares: within three standard deviations the pose tilted the other way fits as well


def board_pose(view: BoardView, target: PrintedTarget, lens: Lens) -> tuple[Array, Array]:
    """(T_camera_target (4, 4) [m], covariance (6, 6) of position and turn about the camera's axes [m², rad²]).

    Where the pose that is tilted the other way fits as well, the covariance holds both.
    """
    table = CornerTable.of([view], target)
    found = board_poses(table, lens, np.zeros(SHAPE))
    T = found.T[0, 0]
    G = grams(table, corner_rows(table, lens, np.zeros(SHAPE), T[None]))[0][:POSE, :POSE]
    at_camera = np.linalg.pinv(G, hermitian=True)
    # a twist about the camera, as a shift of the target's origin and a turn
    J = np.eye(POSE)
    J[:3, 3:] = -so3.hat(T[:3, 3])
    cov = J @ at_camera @ J.T
    if found.cost[0, 1] - found.cost[0, 0] < _TWIN:
        off = se3.error(T, found.T[0, 1])
        cov = cov + np.outer(off, off)
    return T, 0.5 * (cov + cov.T)

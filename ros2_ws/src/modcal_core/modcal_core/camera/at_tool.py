"""Where the flange is by a camera fit, and how everything that was fitted moves it."""

from __future__ import annotations

import numpy as np

from modcal_core.camera.fit import CameraFit
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array


def flange_in_tool(fit: CameraFit) -> Array:
    """The flange in the frame of whatever the arm carries, (3,) [m]."""
    return np.asarray(se3.inverse(fit.poses.model_at(fit.state.values).T_tip_tool)[:3, 3])


def at_flange(T: Array, point: Array, motions: Array) -> Array:
    """Motion of a point (3,) of the tool along the frame, (M, 3, K), for motions (M, 6, K) at poses T (M, 4, 4)."""
    away = T[:, :3, :3] @ point
    return np.asarray(motions[:, :3] - np.cross(away[:, :, None], motions[:, 3:], axisa=1, axisb=1, axisc=1))


def frame_basis(at_frame: Array) -> Array:
    """Orthonormal columns (3 M, 6): how points (M, 3) move with a rigid motion of their frame."""
    M = len(at_frame)
    placed = np.concatenate([np.broadcast_to(np.eye(3), (M, 3, 3)), -so3.hat(at_frame)], axis=2)
    return np.asarray(np.linalg.qr(placed.reshape(3 * M, -1))[0])


def flange_motions(fit: CameraFit, q: Array) -> Array:
    """Motion of the flange at postures q (M, n) per parameter of arm, effects and other instruments, (M, 3, P)."""
    T, motions = fit.poses.at_postures(q).tool_motions(fit.state.values)
    return at_flange(T, flange_in_tool(fit), motions)

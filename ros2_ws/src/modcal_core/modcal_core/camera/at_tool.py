"""Where the flange is by a camera fit, and how everything that was fitted moves it."""

from __future__ import annotations

import numpy as np

from modcal_core.camera.fit import CameraFit
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array


def flange_in_tool(fit: CameraFit) -> Array:
    """The flange in the frame of whatever the arm carries, (3,) [m]."""
    return np.asarray(se3.inverse(fit.poses.model_at(fit.state.values).T_tip_tool)[:3, 3])


def at_flange(T: Array, point: Array, motions: Array) -> Array:
    """Motion of a point (3,) of the tool along the frame, (M, 3, K), for motions (M, 6, K) at poses T (M, 4, 4)."""
    away = T[:, :3, :3] @ point
    return np.asarray(motions[:, :3] - np.cross(away[:, :, None], motions[:, 3:], axisa=1, axisb=1, axisc=1))


def flange_motions(fit: CameraFit, q: Array) -> Array:
    """Motion of the flange at postures q (M, n) per parameter of arm, effects and other instruments, (M, 3, P)."""
    T, motions = fit.poses.at_postures(q).tool_motions(fit.state.values)
    return at_flange(T, flange_in_tool(fit), motions)

"""Images that a fit has not seen: how many pixels it misses them by, which is no accuracy."""

from __future__ import annotations

import numpy as np

from modcal_core.camera.arm_poses import ArmPoses
from modcal_core.camera.corners import CornerTable
from modcal_core.camera.fit import CameraFit, fit_camera, missed_pixels
from modcal_core.camera.mounting import MIN_VIEWS

_HELD_OUT = 4  # every fourth image


def held_out(fit: CameraFit, nominal: CameraFit, arm: float | None) -> tuple[float, float]:
    """RMS of (nominal, calibrated) on every fourth image, fitted to the others at the same sizes [px]."""
    N = fit.table.views
    held = np.arange(N) % _HELD_OUT == _HELD_OUT - 1
    if held.sum() == 0 or (~held).sum() < MIN_VIEWS:
        return float("nan"), float("nan")
    out = []
    for one, size in ((nominal, None), (fit, arm)):
        poses = one.poses.select(~held)
        table = one.table.select(~held)
        there = fit_camera(table, poses, one.state.lens, one.prior, one.sizes, size, fixed_sizes=True)
        out.append(_predicted_px(there, one.table.select(held), one.poses.select(held)))
    return out[0], out[1]


def _predicted_px(fit: CameraFit, table: CornerTable, poses: ArmPoses) -> float:
    gap = missed_pixels(table, poses, fit.state)
    return float(np.sqrt((table.weight @ (gap**2).sum(1)) / max(table.weight.sum(), 1.0)))

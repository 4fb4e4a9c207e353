"""Parts of a calibration by camera's data: a move among the images, other cameras, what the stated size is worth."""

from __future__ import annotations

from typing import Any

import numpy as np

from modcal_core.camera.several import FurtherSeen
from modcal_core.camera.solve import CameraSolution


def moved_data(solution: CameraSolution) -> dict[str, Any]:
    """What was moved among the images, where something was."""
    moved = solution.moved
    assert moved is not None
    what = "target" if moved.in_world == solution.fit.poses.camera_on_tip else "camera"
    return {
        "what": what,
        "before_image": solution.fit.table.names[moved.at],
        "shift_mm": 1e3 * moved.shift_m,
        "turn_deg": float(np.degrees(moved.turn_rad)),
        "focal_percent": 100.0 * moved.focal,
    }


def further_data(one: FurtherSeen) -> dict[str, Any]:
    """A further camera."""
    lens = one.state.lens
    return {
        "name": one.name,
        "mounting": "tip" if one.mounting.camera_on_tip else "world",
        "target": one.target.label,
        "images": {"given": one.given, "used": one.used, "left_out": one.left_out},
        "rms_px": one.rms_px,
        "lens": {
            name: {"value": float(lens.values[i]), "std": float(one.std[i])}
            for i, name in enumerate(lens.names)
            if lens.used[i]
        },
        "clock_s": one.state.offset_s,
        "readout_s": one.state.readout_s,
    }


def rests_on_data(solution: CameraSolution) -> dict[str, float] | None:
    """What the stated size of the target is worth, None where the images show it."""
    rests = solution.rests_on
    if rests is None:
        return None
    return {
        "images_percent": 100.0 * rests.images_std,
        "mm_per_percent": 10.0 * rests.per_unit_m,
        "if_wrong_high95_mm": 1e3 * rests.if_wrong_m,
    }

"""Pictures of a calibration by camera: where corners were in the images, and how far each image is from the arm."""

from __future__ import annotations

import numpy as np

from modcal_core.camera import CameraFit, distances_of_views
from modcal_core.measurements import spread_rows
from modcal_core.report.page import AFTER, Chart
from modcal_core.report.panel import Panel

_DRAWN = 4000  # corners in a picture; more only make the page heavy


def camera_charts(fit: CameraFit) -> list[Chart]:
    """Coverage of the image by corners, and the distance of each image's target from where the arm has it."""
    used = np.flatnonzero(fit.table.weight > 0.0)
    rows = used[spread_rows(len(used), _DRAWN)]
    w, h = fit.state.lens.size
    covered = Panel((0.0, float(w)), (-float(h), 0.0))
    covered.hollow(fit.table.pixels[rows, 0], -fit.table.pixels[rows, 1], AFTER, "circle")
    off = np.sqrt(distances_of_views(fit) / 6.0)
    number = np.arange(1, len(off) + 1, dtype=float)
    apart = Panel((0.0, float(len(off) + 1)), (0.0, 1.1 * max(float(off.max()), 2.0)))
    apart.hollow(number, off, AFTER, "circle")
    return [
        covered.chart(
            "covered", "u, px", "−v, px", "Where corners were in the images.",
            "where corners were in the images: the lens is known where they are",
        ),
        apart.chart(
            "apart", "image", "distance, σ", "How far each image is from where the arm has its target.",
            "how far each image's target is from where the arm has it; one is usual",
        ),
    ]  # fmt: skip

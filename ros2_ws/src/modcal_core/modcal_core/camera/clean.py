"""What is left out before and after the fit: corners that miss their image's pose, images that miss the arm."""

from __future__ import annotations

import numpy as np

from modcal_core.calibration.distributions import exceeded_chi2, median_chi2
from modcal_core.camera.corners import POSE, CornerTable, corner_rows
from modcal_core.camera.fit import CameraFit
from modcal_core.camera.lens import Lens
from modcal_core.geometry.so3 import Array

_TO_SIGMA = 1.4826  # of a median absolute deviation, for normal errors
_CORNER = 6.0  # robust standard deviations: one good corner in a billion
_CORNER_PX = 0.1  # where printers put a square's corner: 0.03 mm, in an image of a third of a millimetre a pixel
_IMAGE_PX, _IMAGE_TIMES = 1.0, 5.0  # RMS of an image that is blurred or misread: more than a pixel, and than the others
_ONE_LINE = 0.1  # of its length, how wide a group of corners is that is none
_ALL_BUT_ONE = 0.03  # the same once any one of them is left out; of a board's corners on a line nothing, of others 0.05
_VIEW_CHANCE = 1e-7  # of an image as far off as this, were it like the others
MIN_CORNERS = 4  # of an image, not on one line: the fewest that a homography is taken from


def corner_weights(table: CornerTable, lens: Lens, shape: Array, T_camera_target: Array) -> Array:
    """1 for corners that agree with the pose of the target in their own image, or nearly, else 0, (M,)."""
    rows = corner_rows(table, lens, shape, T_camera_target)
    size = np.abs(rows.residual)
    sigma = _TO_SIGMA * np.median(size[table.weight > 0.0])
    agrees = (size <= _CORNER * max(float(sigma), 1e-9)) | (np.abs(rows.pixels) <= _CORNER_PX)
    return np.where(agrees.all(axis=1), table.weight, 0.0)


def enough_corners(points: Array) -> bool:
    """Whether corners at these places on the sheet (m, 3) fix its pose: four of them, of which no three are on a line.

    That is so where they are not on one line, and are not once any one of them is left out.
    """
    m = len(points)
    if m < MIN_CORNERS:
        return False
    off = points[:, :2] - points[:, :2].mean(axis=0)
    scatter = off.T @ off
    without = scatter - m / (m - 1.0) * off[:, :, None] * off[:, None]
    spread = np.linalg.eigvalsh(np.concatenate([scatter[None], without]))
    width = np.sqrt(np.maximum(spread[:, 0], 0.0) / spread[:, 1])
    return bool(width[0] > _ONE_LINE and width[1:].min() > _ALL_BUT_ONE)


def bad_images(table: CornerTable, rms_px: Array) -> np.ndarray:
    """Images (N,) in which the target has too few corners left, or fits far worse than in the others."""
    kept = np.bincount(table.view, table.weight, table.views)
    worst = max(_IMAGE_PX, _IMAGE_TIMES * float(np.median(rms_px)))
    few = [not enough_corners(table.points[table.of_view(i)][_kept(table, i)]) for i in range(table.views)]
    return np.asarray(few) | (kept < MIN_CORNERS) | (rms_px > worst)


def _kept(table: CornerTable, view: int) -> np.ndarray:
    return np.asarray(table.weight[table.of_view(view)] > 0.0)


def distances_of_views(fit: CameraFit) -> Array:
    """Squared distance of each image's pose from the arm's, in its own standard deviations, (N,): six on average."""
    G = fit.equations.grams / fit.sizes.noise**2
    Gpp, g = G[:, :POSE, :POSE], G[:, :POSE, -1:]
    Q = fit.equations.covariance_of_views(fit.sizes)
    inverse = np.linalg.pinv(Gpp, hermitian=True)
    off = inverse @ g
    return np.asarray((np.swapaxes(off, 1, 2) @ np.linalg.solve(inverse + Q, off))[:, 0, 0])


def strangers(fit: CameraFit) -> np.ndarray:
    """Images (N,) whose pose of the target is nowhere near the arm's, the others' scatter being the scale."""
    square = distances_of_views(fit)
    scale = max(float(np.median(square)) / median_chi2(POSE), 0.1)
    return np.asarray(square > scale * exceeded_chi2(_VIEW_CHANCE, POSE))

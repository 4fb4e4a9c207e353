"""The lens from images alone, the target anywhere in each of them: least squares over lens and poses together.

Poses are eliminated image by image (Schur complement), so that the step is solved for the lens only. No prior: the
minimum is that of any other program on the same corners.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.camera.corners import POSE, SHAPE, CornerTable, corner_rows, grams
from modcal_core.camera.homography import homography, lens_of_homographies
from modcal_core.camera.lens import COUNT, FISHEYE, PINHOLE, Lens
from modcal_core.camera.pnp import board_poses
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array

_STEPS = 100  # of Gauss and Newton, at most
_MET = 1e-12  # relative gain of the cost
_FLAT = np.zeros(SHAPE)
_HALF_ANGLES = np.radians([35.0, 45.0, 55.0, 65.0, 80.0, 95.0])  # of fisheyes, from the middle to the farther edge
_MANY, _MIN = 8, 3  # corners of an image that shows perspective well, and images of that kind that are enough


@dataclass(frozen=True)
class LensFit:
    """A lens and the target's pose in each image, T_camera_target (N, 4, 4) [m]. cost: sum of whitened squares.

    rms: [px]. cov: of the lens's values, (9, 9), rows and columns of those held fixed zero. converged: whether it met.
    """

    lens: Lens
    T_camera_target: Array
    cost: float
    rms: float
    cov: Array
    converged: bool


def first_lens(table: CornerTable, size: tuple[int, int], model: str = PINHOLE) -> Lens:
    """A lens to begin with: of a pinhole from the homographies of all images, of a fisheye the one of some angles of
    view that meets the images best. Raises NotEnoughData.
    """
    if model == FISHEYE:
        middle = 0.5 * (np.array(size) - 1.0)
        tried = [
            Lens(np.r_[[0.5 * max(size) / angle] * 2, middle, np.zeros(5)], size, FISHEYE) for angle in _HALF_ANGLES
        ]
        return min(tried, key=lambda lens: float(np.median(board_poses(table, lens, _FLAT).rms)))
    counts = np.bincount(table.view, minlength=table.views)
    many = np.flatnonzero(counts >= _MANY)
    found = []
    for i in many if len(many) >= _MIN else range(table.views):
        rows = table.of_view(int(i))
        found.append(homography(table.points[rows, :2], table.pixels[rows]))
    return lens_of_homographies(found, size)


def fit_lens(table: CornerTable, start: Lens, free: np.ndarray | None = None, prior: Array | None = None) -> LensFit:
    """The lens, from this start, and poses with least squares over all corners.

    free: which of its nine values to fit, (9,) bool; None: all. prior: information (9, 9) about the start; None: none.
    """
    use = np.flatnonzero(start.used if free is None else free & start.used)
    P0 = np.zeros((len(use), len(use))) if prior is None else prior[np.ix_(use, use)]
    lens, T = start, board_poses(table, start, _FLAT).T[:, 0]
    damping, converged = 1e-4, False
    G = grams(table, corner_rows(table, lens, _FLAT, T))
    off = np.zeros(len(use))
    cost = float(G[:, -1, -1].sum())
    for _ in range(_STEPS):
        p, c = slice(0, POSE), POSE + use
        Hpp = G[:, p, p] * (1.0 + damping * np.eye(POSE))
        Hpp = Hpp + (np.einsum("nii->n", Hpp) == 0.0)[:, None, None] * np.eye(POSE)  # all corners left out: any pose
        Hcp = G[:, c, p]
        back = np.linalg.solve(Hpp, np.concatenate([np.swapaxes(Hcp, 1, 2), G[:, p, -1:]], axis=2))
        H = (G[:, c[:, None], c]).sum(0) - (Hcp @ back[:, :, :-1]).sum(0) + P0
        g = (G[:, c, -1] - (Hcp @ back[:, :, -1:])[:, :, 0]).sum(0) - P0 @ off
        scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        step = scale * np.linalg.solve(H * np.outer(scale, scale) + damping * np.eye(len(use)), scale * g)
        moves = back[:, :, -1] - back[:, :, :-1] @ step
        values = lens.values.copy()
        values[use] += step
        new_lens, new_T = lens.moved(values - lens.values), se3.exp(moves) @ T
        new_G = grams(table, corner_rows(table, new_lens, _FLAT, new_T))
        new_cost = float(new_G[:, -1, -1].sum() + (off + step) @ P0 @ (off + step))
        if new_cost <= cost and values[:2].min() > 0.0:
            gain = cost - new_cost
            lens, T, G, off, cost = new_lens, new_T, new_G, off + step, new_cost
            damping = max(0.1 * damping, 1e-12)
            if gain <= _MET * max(cost, 1e-30):
                converged = True
                break
        else:
            damping = max(10.0 * damping, 1e-9)
            if damping > 1e8:
                converged = True  # no step of any size is better
                break
    cov = np.zeros((COUNT, COUNT))
    cov[np.ix_(use, use)] = np.linalg.pinv(_of_lens(G, use) + P0, hermitian=True)
    rows = corner_rows(table, lens, _FLAT, T)
    w = table.weight
    rms = float(np.sqrt((w @ (rows.pixels**2).sum(1)) / max(w.sum(), 1.0)))
    return LensFit(lens, T, cost, rms, cov, converged)


def _of_lens(G: Array, use: np.ndarray) -> Array:
    """Information of these values of the lens, the poses taken out of the products of all images, undamped."""
    poses, c = G[:, :POSE, :POSE], POSE + use
    across = G[:, c, :POSE]
    taken = across @ np.linalg.pinv(poses, hermitian=True) @ np.swapaxes(across, 1, 2)
    return np.asarray((G[:, c[:, None], c] - taken).sum(0))

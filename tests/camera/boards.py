"""Views of a board through OpenCV's projection, which shares no code with what is under test."""

from __future__ import annotations

import cv2
import numpy as np

from modcal_core.camera.bundle import CHARUCO, BoardView, PrintedTarget
from modcal_core.camera.lens import FISHEYE, Lens
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array

SIZE = (1280, 720)
BOARD = PrintedTarget(CHARUCO, 7, 5, 0.03, 0.022, "DICT_5X5_100")
LENS = Lens(np.array([910.0, 915.0, 655.0, 350.0, -0.12, 0.08, 0.0008, -0.0006, -0.01]), SIZE)


def facing(rng: np.random.Generator, count: int, tilt: float = 0.6, near: float = 0.3, far: float = 0.5) -> Array:
    """Poses of the board's frame in front of a camera, T_camera_target (count, 4, 4), its centre near the axis."""
    centre = np.r_[0.5 * np.array(BOARD.size), 0.0]
    axis = rng.normal(size=(count, 2))
    axis *= rng.uniform(0.2, 1.0, (count, 1)) * tilt / np.linalg.norm(axis, axis=1, keepdims=True)
    R = so3.exp(np.c_[axis, np.zeros(count)]) @ so3.exp(np.c_[np.zeros((count, 2)), rng.uniform(-1.0, 1.0, count)])
    z = rng.uniform(near, far, count)
    at = np.c_[z[:, None] * rng.uniform([-0.25, -0.12], [0.25, 0.12], (count, 2)), z]
    return se3.transform(R, at - R @ centre)


def seen(T: Array, points: Array, lens: Lens) -> Array:
    """Pixels (m, 2) of points (m, 3) on a board at T, by OpenCV."""
    rotation = cv2.Rodrigues(np.ascontiguousarray(T[:3, :3]))[0]
    if lens.model == FISHEYE:
        at = np.ascontiguousarray(points).reshape(-1, 1, 3)
        return np.asarray(cv2.fisheye.projectPoints(at, rotation, T[:3, 3], lens.K, lens.values[4:8])[0]).reshape(-1, 2)
    return np.asarray(cv2.projectPoints(points, rotation, T[:3, 3], lens.K, lens.values[4:])[0]).reshape(-1, 2)


def views(
    rng: np.random.Generator, T: Array, noise: float = 0.1, lens: Lens = LENS, board: PrintedTarget = BOARD,
    printed: Array | None = None,
) -> list[BoardView]:  # fmt: skip
    """Views of the corners inside the image, with white noise [px]. printed: where the sheet has them, if elsewhere."""
    out = []
    points = board.points if printed is None else printed
    for i, pose in enumerate(T):
        exact = seen(pose, points, lens)
        inside = np.flatnonzero(((exact > 0.0) & (exact < np.array(lens.size) - 1.0)).all(axis=1))
        noisy = exact[inside] + noise * rng.standard_normal((len(inside), 2))
        cov = np.tile(max(noise, 1e-3) ** 2 * np.eye(2), (len(inside), 1, 1))
        out.append(BoardView(f"{i}.png", inside, noisy, cov))
    return out

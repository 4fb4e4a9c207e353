"""Images of a printed board by a small ray tracer: each pixel's ray, by OpenCV's lens, meets the sheet's bitmap.

Shares no code with what is under test. Several rays a pixel, then blur, vignetting and noise of grey values.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from modcal_core.camera.lens import Lens
from modcal_core.camera.target import CHARUCO, PrintedTarget
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array

_PER_M = 8000.0  # pixels of the bitmap per metre of the sheet: eight a millimetre
_BORDER_M = 0.012  # white paper around the pattern


@cache
def bitmap(board: PrintedTarget) -> np.ndarray:
    """The pattern in white paper, _PER_M pixels a metre."""
    border = int(_BORDER_M * _PER_M)
    width, height = (round(side * _PER_M) + 2 * border for side in board.size)
    if board.kind == CHARUCO:
        words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
        made = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square, board.marker, words)
        return np.asarray(made.generateImage((width, height), marginSize=border))
    out = np.full((height, width), 255, np.uint8)
    s = board.square * _PER_M
    for r in range(board.rows):
        for c in range(board.columns):
            if (r + c) % 2 == 0:
                y, x = border + int(r * s), border + int(c * s)
                out[y : border + int((r + 1) * s), x : border + int((c + 1) * s)] = 0
    return out


def render(
    T_camera_target: Array, lens: Lens, board: PrintedTarget, rng: np.random.Generator, blur: float = 0.8,
    noise: float = 3.0, rays: int = 2, scale: tuple[float, float] = (1.0, 1.0), bow: Array | None = None,
) -> np.ndarray:  # fmt: skip
    """A grey image of 8 bits. blur: standard deviation [px]. scale: how much larger the print came out in x and y.
    bow: how far it leaves the plane by x², x y and y² about its middle, at half its corners' diagonal, (3,) [m].
    """
    w, h = lens.size
    sheet = bitmap(board)
    step = 1.0 / rays
    x = (np.arange(w * rays) + 0.5) * step - 0.5
    y = (np.arange(h * rays) + 0.5) * step - 0.5
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 1, 2).astype(np.float32)
    ray = cv2.undistortPoints(grid, lens.K, lens.values[4:]).reshape(-1, 2)
    T = se3.inverse(T_camera_target)
    direction = np.c_[ray, np.ones(len(ray))] @ T[:3, :3].T
    distance = -T[2, 3] / direction[:, 2]
    at = T[:2, 3] + distance[:, None] * direction[:, :2]
    if bow is not None:
        points = board.points[:, :2]
        middle, half = 0.5 * (points.max(0) + points.min(0)), 0.5 * np.linalg.norm(np.ptp(points, axis=0))
        for _ in range(3):  # to where the ray meets the bent sheet
            u, v = np.clip((at - middle) / half, -2.0, 2.0).T
            distance = (bow[0] * u * u + bow[1] * u * v + bow[2] * v * v - T[2, 3]) / direction[:, 2]
            at = T[:2, 3] + distance[:, None] * direction[:, :2]
    at = at / np.array(scale) * _PER_M + _BORDER_M * _PER_M - 0.5
    at[distance <= 0.0] = -1e6
    coordinates = at.reshape(h * rays, w * rays, 2).astype(np.float32)
    sampled = cv2.remap(sheet, coordinates[..., 0], coordinates[..., 1], cv2.INTER_LINEAR, borderValue=150)
    image = cv2.resize(sampled.astype(np.float32), (w, h), interpolation=cv2.INTER_AREA)
    image = 30.0 + 0.75 * cv2.GaussianBlur(image, (0, 0), blur)
    r2 = ((np.arange(w) / w - 0.5) ** 2)[None] + ((np.arange(h) / h - 0.5) ** 2)[:, None]
    image = image * (1.0 - 0.3 * r2) + noise * rng.standard_normal((h, w))
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)

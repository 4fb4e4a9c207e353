"""Images of a printed board by a small ray tracer: each pixel's ray, by OpenCV's lens, meets the sheet's bitmap.

Shares no code with what is under test. Several rays a pixel, then blur, vignetting and noise of grey values.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from modcal_core.camera.bundle import CHARUCO, PrintedTarget
from modcal_core.camera.lens import Lens
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
    T = se3.inverse(T_camera_target)
    left, top, right, bottom = _around(T_camera_target, lens, board)
    sampled = np.full((h * rays, w * rays), 150.0, np.float32)
    part = _rays(lens.values.tobytes(), lens.size)[top:bottom, left:right]
    if part.size:
        ray = part.reshape(-1, 2)
        direction = ray @ T[:3, :2].T + T[:3, 2]
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
        # rays between the middles of pixels meet the sheet between where those do, to 1e-4 of a pixel
        size = (rays * part.shape[1], rays * part.shape[0])
        coordinates = cv2.resize(at.reshape(part.shape), size, interpolation=cv2.INTER_LINEAR).astype(np.float32)
        seen = cv2.remap(sheet, coordinates[..., 0], coordinates[..., 1], cv2.INTER_LINEAR, borderValue=150)
        sampled[top * rays : bottom * rays, left * rays : right * rays] = seen
    image = cv2.resize(sampled, (w, h), interpolation=cv2.INTER_AREA)
    image = 30.0 + 0.75 * cv2.GaussianBlur(image, (0, 0), blur)
    r2 = ((np.arange(w) / w - 0.5) ** 2)[None] + ((np.arange(h) / h - 0.5) ** 2)[:, None]
    image = image * (1.0 - 0.3 * r2) + noise * rng.standard_normal((h, w))
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


@cache
def _rays(values: bytes, size: tuple[int, int]) -> Array:
    """Where the ray of the middle of each pixel meets z = 1, (h, w, 2)."""
    w, h = size
    lens = np.frombuffer(values)
    K = np.array([[lens[0], 0.0, lens[2]], [0.0, lens[1], lens[3]], [0.0, 0.0, 1.0]])
    grid = np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=-1).reshape(-1, 1, 2).astype(float)
    met = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-12)  # OpenCV's five steps may leave a pixel
    return np.asarray(cv2.undistortPoints(grid, K, lens[4:], criteria=met)).reshape(h, w, 2)


def _around(T: Array, lens: Lens, board: PrintedTarget) -> tuple[int, int, int, int]:
    """Left, upper, right and lower end of the pixels that may show the sheet; all of them where that is not plain."""
    w, h = lens.size
    side = np.linspace(0.0, 1.0, 21)
    low, high = -_BORDER_M, np.array(board.size) + _BORDER_M
    edge = np.concatenate([[(s, 0), (s, 1), (0, s), (1, s)] for s in side])
    X = np.c_[low + 1.05 * edge * (high - low) - 0.025 * (high - low), np.zeros(len(edge))] @ T[:3, :3].T + T[:3, 3]
    if X[:, 2].min() < 0.05:
        return 0, 0, w, h
    at = cv2.projectPoints(X, np.zeros(3), np.zeros(3), lens.K, lens.values[4:])[0].reshape(-1, 2)
    (left, top), (right, bottom) = np.floor(at.min(0)).astype(int) - 8, np.ceil(at.max(0)).astype(int) + 8
    return max(left, 0), max(top, 0), max(min(right, w), 0), max(min(bottom, h), 0)

"""Homographies of a flat target, and the lens that they are the images of: the start where no intrinsics are given.

A homography H takes the sheet's x, y, 1 to pixels (direct linear transform, Hartley's scaling). Its first two columns
are images of two unit vectors at right angles, which gives two equations for the focal lengths (Zhang 2000), the
principal point being taken to be the middle of the image until the fit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.camera.lens import Lens
from modcal_core.errors import NotEnoughData
from modcal_core.geometry.so3 import Array

_MIN_TILT = 1e-3  # of the equations; below, all images show the sheet square on


def homography(points: Array, pixels: Array) -> Array:
    """H (3, 3) that takes points (m, 2) of a plane to pixels (m, 2), m ≥ 4; its last element is positive."""
    A, a = _scaled(points)
    B, b = _scaled(pixels)
    one = np.ones(len(a))
    zero = np.zeros((len(a), 3))
    p = np.c_[a, one]
    rows = np.r_[np.c_[p, zero, -b[:, :1] * p], np.c_[zero, p, -b[:, 1:] * p]]
    H = np.linalg.inv(B) @ np.linalg.svd(rows)[2][-1].reshape(3, 3) @ A
    centre = np.r_[points.mean(0), 1.0]
    return np.asarray(H * np.sign(H[2] @ centre) / np.linalg.norm(H))


def lens_of_homographies(found: Sequence[Array], size: tuple[int, int]) -> Lens:
    """The lens without distortion, principal point in the middle, that these homographies (3, 3) are images of.

    Raises NotEnoughData where they do not tell its focal lengths.
    """
    cx, cy = 0.5 * (size[0] - 1), 0.5 * (size[1] - 1)
    middle = np.array([[1.0, 0.0, -cx], [0.0, 1.0, -cy], [0.0, 0.0, 1.0]])
    scale = np.diag([1.0 / max(size), 1.0 / max(size), 1.0])
    rows, right = [], []
    for H in found:
        h = scale @ middle @ H
        h = h / np.sqrt(np.linalg.norm(h[:, 0]) * np.linalg.norm(h[:, 1]))
        d1, d2 = h[:, 0] + h[:, 1], h[:, 0] - h[:, 1]
        rows += [h[:2, 0] * h[:2, 1], 0.5 * d1[:2] * d2[:2]]
        right += [-h[2, 0] * h[2, 1], -0.5 * d1[2] * d2[2]]
    A, b = np.array(rows), np.array(right)
    inverse_squares = np.linalg.lstsq(A, b, rcond=None)[0] if len(A) else np.zeros(2)
    if np.abs(b).max(initial=0.0) < _MIN_TILT or not (inverse_squares > 1e-4).all():
        # one focal length for both, which is what nearly every camera has
        both = A.sum(axis=1)
        one = float(both @ b / max(both @ both, 1e-300)) if len(A) else 0.0
        inverse_squares = np.array([one, one])
    if not (inverse_squares > 1e-4).all():
        said = "the images do not show the focal length"
        raise NotEnoughData("camera", said, "tilt the target by 20° to 45° to several sides, or state the intrinsics")
    f = max(size) / np.sqrt(inverse_squares)
    return Lens(np.r_[f, cx, cy, np.zeros(5)], size)


def _scaled(points: Array) -> tuple[Array, Array]:
    """(transform (3, 3), points (m, 2)) with mean zero and mean distance √2 (Hartley 1997)."""
    centre = points.mean(axis=0)
    s = np.sqrt(2.0) / max(float(np.linalg.norm(points - centre, axis=1).mean()), 1e-300)
    return np.array([[s, 0.0, -s * centre[0]], [0.0, s, -s * centre[1]], [0.0, 0.0, 1.0]]), s * (points - centre)

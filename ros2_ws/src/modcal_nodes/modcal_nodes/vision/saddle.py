"""Corners of squares to a hundredth of a pixel: two crossing edges are fitted to the grey values themselves.

About the corner q of four squares the image is

    grey(p) = c · (1, p) + A · erf(n₁·(p − q) / √2 s₁) · erf(n₂·(p − q) / √2 s₂)

with the normals n₁, n₂ of its two edges, the blur s₁, s₂ across them, the contrast A and a brightness c that leans.
Least squares over the pixels of a window has every grey value count as much as it says of q; the mean of gradients that
OpenCV's ``cornerSubPix`` takes differences and interpolates first, which leaves two to four times as much. What the fit
leaves over is the noise, and the covariance of q is its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import erf

from modcal_core.camera import CHARUCO, PrintedTarget
from modcal_core.geometry import Array

_PERSPECTIVE = 6  # corners, of which two are left to say that a perspective through four of them is none
_NEARLY_FLAT = 0.2  # nearest over farthest corner of a board: one that fills the image and is tilted by 60° has 0.3
_REACH = 0.4  # of a square, along its edges: farther the next corner begins
_MAX_PX = 8  # half side of the windows; over more, a lens bends the edges by a hundredth of a pixel and more
_BLUR_PX = 1.0  # to begin with
_NARROW, _WIDE = 0.3, 5.0  # px, of blur: that of a pixel itself, and more than an image that is used has
_CLEAR = 2.0  # widths of blur, that a marker beside a corner stays away from pixels that are used
_MIN_MARGIN = 1.0  # px, of either edge, that is used in any case
_STEPS = 6
_MET_PX = 1e-3  # of a step: a tenth of what the noise leaves
_SHAPE = 6  # unknowns of the edges: q, two angles, two widths of blur
_UNKNOWNS = _SHAPE + 4  # and A, c
_SQRT_2_PI = np.sqrt(2.0 / np.pi)  # of the Gaussian that erf adds up


@dataclass(frozen=True)
class SaddleFit:
    """pixels: of m corners (m, 2). cov: of each for what its window left over [px²], (m, 2, 2). sigma: of the grey
    values about the fit (m,). good: whether the fit met inside its window, (m,) bool.
    """

    pixels: Array
    cov: Array
    sigma: Array
    good: np.ndarray


def fit_board(grey: np.ndarray, target: PrintedTarget, ids: np.ndarray, pixels: Array) -> SaddleFit:
    """The corners with these numbers (m,) of a board of squares, near these pixels (m, 2), not all on one line."""
    margin = 0.5 * (target.square - target.marker) / target.square if target.kind == CHARUCO else 0.5
    return fit_saddles(grey, pixels, target.square * _per_metre(target.points[ids, :2], pixels), margin)


def homography(points: Array, pixels: Array) -> Array:
    """H (3, 3) that takes points (m, 2) of a plane to pixels (m, 2), NaN where either are on one line."""
    H, _ = cv2.findHomography(points, pixels)
    return np.full((3, 3), np.nan) if H is None else np.asarray(H)


def _per_metre(points: Array, pixels: Array) -> Array:
    """Derivatives (m, 2, 2) of pixels (m, 2) by places on the sheet (m, 2) [m], by what all of them say."""
    ones = np.ones(len(points))
    flat = np.linalg.lstsq(np.c_[points, ones], pixels, rcond=None)[0][:2].T  # as if seen from far away
    if len(points) >= _PERSPECTIVE:
        H = homography(points, pixels)
        at = np.c_[points, ones] @ H.T
        ahead = at[:, 2] * np.sign(at[:, 2].sum())
        if ahead.min() > _NEARLY_FLAT * ahead.max():  # else four of few corners are on one line
            here = at[:, :2] / at[:, 2:]
            return np.asarray((H[None, :2, :2] - here[:, :, None] * H[2, :2]) / at[:, 2, None, None])
    return np.broadcast_to(flat, (len(points), 2, 2)).copy()


def fit_saddles(grey: np.ndarray, pixels: Array, axes: Array, margin: float) -> SaddleFit:
    """The corners near these pixels (m, 2) of a grey image.

    axes: one square along the board's x and y in the image [px], in the columns of (m, 2, 2). margin: as a share of a
    square, how far from the edges whatever else is printed in a square begins.
    """
    window = _CornerWindow(grey, pixels, axes, margin)
    angles = np.arctan2(axes[:, 1], axes[:, 0]) + 0.5 * np.pi  # of the normals of the edges along x and y
    x = np.c_[pixels - window.origin, angles, np.full((len(pixels), 2), _BLUR_PX)]
    used = window.used(x[:, 4:].max(axis=1))
    H, b, cost = window.at(x, used)
    damping = np.full(len(x), 1e-3)
    for i in range(_STEPS):
        damped = H + (np.einsum("mii->mi", H) * damping[:, None])[:, :, None] * np.eye(_UNKNOWNS)
        step = np.linalg.solve(damped, b)[:, :_SHAPE, 0]
        tried = x + step
        tried[:, 4:] = np.clip(tried[:, 4:], _NARROW, _WIDE)
        new = window.at(tried, used)
        better = new[2] <= cost
        x = np.where(better[:, None], tried, x)
        damping = np.where(better, 0.1 * damping, 10.0 * damping)
        if i == 1:  # the blur is known now, and with it what a marker beside the corner spoils
            used = window.used(x[:, 4:].max(axis=1))
        H, b, cost = new if better.all() and i != 1 else window.at(x, used)
        if i > 1 and float(np.abs(step[:, :2]).max(initial=0.0)) < _MET_PX:
            break
    count = used.sum(axis=1)
    sigma = np.sqrt(cost / np.maximum(count - _UNKNOWNS, 1))
    cov = np.linalg.inv(H)[:, :2, :2] * (sigma**2)[:, None, None]
    moved = np.linalg.norm(window.origin + x[:, :2] - pixels, axis=1)
    good = (np.abs(step[:, :2]).max(axis=1) < 0.1) & (moved < 0.5 * window.half) & (count > 2 * _UNKNOWNS)
    return SaddleFit(window.origin + x[:, :2], cov, sigma, good & np.isfinite(cov).all(axis=(1, 2)))


class _CornerWindow:
    """The pixels about m corners, K each, and what is predicted of them."""

    def __init__(self, grey: np.ndarray, pixels: Array, axes: Array, margin: float) -> None:
        side = np.linalg.norm(axes, axis=1).min(axis=1)  # px, of the squares
        self.half = int(np.clip(np.ceil(_REACH * float(np.median(side))), 2, _MAX_PX))
        self.origin = np.rint(pixels)
        steps = np.arange(-self.half, self.half + 1)
        self.offsets = np.stack([axis.ravel() for axis in np.meshgrid(steps, steps)], axis=1).astype(float)
        at = self.origin[:, None] + self.offsets
        inside = ((at >= 0.0) & (at < np.array(grey.shape)[::-1])).all(axis=2)
        clipped = np.clip(at, 0.0, np.array(grey.shape)[::-1] - 1.0).astype(int)
        self.grey = grey[clipped[:, :, 1], clipped[:, :, 0]].astype(float)
        away = np.abs(np.linalg.solve(axes[:, None], (at - pixels[:, None])[:, :, :, None])[:, :, :, 0])  # in squares
        self._inside = inside & (away.max(axis=2) < _REACH)
        self._from_edges = away.min(axis=2) * side[:, None]
        self._margin = margin * side

    def used(self, blur: Array) -> np.ndarray:
        """Which pixels (m, K) no print beside the edges reaches, for a blur (m,) [px]."""
        margin = np.maximum(self._margin - _CLEAR * blur, _MIN_MARGIN)
        return self._inside & (self._from_edges < margin[:, None])

    def at(self, x: Array, used: np.ndarray) -> tuple[Array, Array, Array]:
        """Normal equations H (m, 10, 10) and b (m, 10, 1), and cost (m,), at q, angles and blur (m, 6), brightness and
        contrast being those that fit best.
        """
        p = self.offsets[None] - x[:, None, :2]
        cos, sin = np.cos(x[:, 2:4]), np.sin(x[:, 2:4])
        u = p[:, :, :1] * cos[:, None] + p[:, :, 1:] * sin[:, None]  # (m, K, 2), from either edge
        across = -p[:, :, :1] * sin[:, None] + p[:, :, 1:] * cos[:, None]
        blur = x[:, None, 4:]
        z = u / (np.sqrt(2.0) * blur)
        E = erf(z)
        G = _SQRT_2_PI / blur * np.exp(-z * z)
        J = np.empty((*self.grey.shape, _UNKNOWNS))
        linear = J[:, :, _SHAPE:]
        linear[:, :, 0] = E[:, :, 0] * E[:, :, 1]
        linear[:, :, 1] = 1.0
        linear[:, :, 2:] = self.offsets
        weight = used.astype(float)
        weighted = np.swapaxes(linear * weight[:, :, None], 1, 2)
        N = weighted @ linear + 1e-9 * np.eye(4)
        c = np.linalg.solve(N, weighted @ self.grey[:, :, None])
        residual = (self.grey - (linear @ c)[:, :, 0]) * weight
        by = c[:, None, 0] * G * E[:, :, ::-1]  # (m, K, 2), by u
        J[:, :, :2] = -(by[:, :, :1] * np.stack([cos[:, 0], sin[:, 0]], 1)[:, None])
        J[:, :, :2] -= by[:, :, 1:] * np.stack([cos[:, 1], sin[:, 1]], 1)[:, None]
        J[:, :, 2:4] = by * across
        J[:, :, 4:6] = -by * u / blur
        J *= weight[:, :, None]
        by_each = np.swapaxes(J, 1, 2)
        return by_each @ J + 1e-9 * np.eye(_UNKNOWNS), by_each @ residual[:, :, None], (residual**2).sum(axis=1)

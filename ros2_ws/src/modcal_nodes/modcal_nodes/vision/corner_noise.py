"""How well an image says where a corner is.

A corner q is refined as the point whose directions to its neighbours p lie across their gradients: Σ g gᵀ (q − p) = 0.
Grey noise σ puts noise of σ / √2 into a gradient by central differences, which moves q by H⁻¹ Σ g (n · (p − q)) with
H = Σ g gᵀ; so its covariance is ½ σ² H⁻¹ (Σ |p − q|² g gᵀ) H⁻¹, in the weights that the refinement uses.
"""

from __future__ import annotations

import cv2
import numpy as np

from modcal_core.geometry.so3 import Array

_MIN_PX, _MAX_PX = 0.02, 2.0  # standard deviation of a corner: what interpolation alone leaves, and a useless one
_PRINT_PX = 0.02  # standard deviation of what printer, paper and the lens's finer form leave beside the noise
_TO_SIGMA = 1.4826  # of a median absolute deviation
_QUANTISED = 0.3  # grey levels, of rounding to whole ones


def grey_noise(grey: np.ndarray) -> float:
    """Standard deviation of the grey values' noise, from second differences across flat parts of the image."""
    f = grey.astype(np.float32)
    d = f[1:-1, 1:-1] * 4.0 - 2.0 * (f[:-2, 1:-1] + f[2:, 1:-1] + f[1:-1, :-2] + f[1:-1, 2:])
    d += f[:-2, :-2] + f[:-2, 2:] + f[2:, :-2] + f[2:, 2:]  # Immerkær's mask, whose weights have norm 6
    return max(float(_TO_SIGMA * np.median(np.abs(d)) / 6.0), _QUANTISED)


def corner_covariance(grey: np.ndarray, pixels: Array, half: int, sigma: float) -> Array:
    """Covariance of corners at pixels (m, 2) refined in windows of this half side, (m, 2, 2) [px²]."""
    offsets = np.arange(-half, half + 1, dtype=float)
    dx, dy = np.meshgrid(offsets, offsets)
    weight = np.exp(-(dx**2 + dy**2) / half**2).ravel()  # as OpenCV's cornerSubPix weighs
    square = (dx**2 + dy**2).ravel()
    out = np.empty((len(pixels), 2, 2))
    for i, (x, y) in enumerate(pixels):
        patch = cv2.getRectSubPix(grey, (2 * half + 3, 2 * half + 3), (float(x), float(y))).astype(float)
        gx = 0.5 * (patch[1:-1, 2:] - patch[1:-1, :-2]).ravel()
        gy = 0.5 * (patch[2:, 1:-1] - patch[:-2, 1:-1]).ravel()
        g = np.stack([gx, gy])
        H = (weight * g) @ g.T
        M = (weight**2 * square * g) @ g.T
        values, vectors = np.linalg.eigh(H)
        inverse = (vectors / np.maximum(values, 1e-6)) @ vectors.T
        out[i] = 0.5 * sigma**2 * inverse @ M @ inverse
    values, vectors = np.linalg.eigh(out)
    values = np.clip(values, _MIN_PX**2, _MAX_PX**2)
    return np.asarray((vectors * values[:, None, :]) @ np.swapaxes(vectors, 1, 2))


def no_better_than_print(cov: Array) -> Array:
    """These covariances (m, 2, 2) with what no picture of one corner shows, [px²]."""
    return np.asarray(cov + _PRINT_PX**2 * np.eye(2))


def edge_width(grey: np.ndarray, pixels: Array, half: int) -> float:
    """Median width of the edges at these corners [px]: contrast over the steepest gradient."""
    widths = []
    reach = max(half, 4)
    for x, y in pixels[:: max(1, len(pixels) // 20)]:
        patch = cv2.getRectSubPix(grey, (2 * reach + 3, 2 * reach + 3), (float(x), float(y))).astype(float)
        gx = 0.5 * (patch[1:-1, 2:] - patch[1:-1, :-2])
        gy = 0.5 * (patch[2:, 1:-1] - patch[:-2, 1:-1])
        steepest = float(np.percentile(np.hypot(gx, gy), 98))
        contrast = float(np.percentile(patch, 95) - np.percentile(patch, 5))
        widths.append(contrast / max(steepest, 1e-6))
    return float(np.median(widths))

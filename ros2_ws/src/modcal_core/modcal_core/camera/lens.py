"""The lens: a pinhole with radial and tangential distortion, or a fisheye, in OpenCV's numbers, and its derivatives.

Pinhole: with x = X / Z, y = Y / Z, r² = x² + y² and D = 1 + k1 r² + k2 r⁴ + k3 r⁶,

    x_d = x D + 2 p1 x y + p2 (r² + 2 x²)        u = fx x_d + cx
    y_d = y D + p1 (r² + 2 y²) + 2 p2 x y        v = fy y_d + cy

(Brown 1971, in the order of OpenCV). A rational polynomial divides D by 1 + k4 r² + k5 r⁴ + k6 r⁶, whose three numbers
stay as stated: images show no difference between them and the others. Fisheye: with θ the angle between ray and axis
and r = tan θ,

    x_d = x / r · θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)          and y_d likewise

(Kannala and Brandt 2006, OpenCV's fisheye, ROS's equidistant). Pixels count from the middle of the upper left one.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.geometry import Array, view

PINHOLE, FISHEYE = "plumb_bob", "equidistant"  # as ROS calls them
NAMES = {
    PINHOLE: ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"),
    FISHEYE: ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "none"),
}
COUNT = 9  # the last of a fisheye's stays zero
DISTORTIONS = {PINHOLE: 5, FISHEYE: 4}  # how many coefficients are fitted
STATED = {PINHOLE: 8, FISHEYE: 4}  # and how many a file may state
_WIDEST = 1.5  # rad from the axis, the farthest that a ray x, y, 1 can show
_ON_AXIS = 1e-9  # of the depth; nearer the axis, a fisheye is a pinhole
_STEPS = 20  # of Newton's method; three are enough near the middle


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a camera. values: fx fy cx cy [px] k1 k2 p1 p2 k3, of a fisheye fx fy cx cy k1 k2 k3 k4 0, (9,).
    size: width and height of images [px]. model: PINHOLE or FISHEYE. below: k4 k5 k6 of a rational polynomial, (3,).
    """

    values: Array
    size: tuple[int, int]
    model: str = PINHOLE
    below: Array = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", view(np.asarray(self.values, dtype=float)))
        object.__setattr__(self, "below", view(np.asarray(self.below, dtype=float)))

    @classmethod
    def plain(cls, focal: float, size: tuple[int, int], model: str = PINHOLE) -> Lens:
        """Without distortion, its centre in the middle of the image. focal: [px]."""
        return cls(np.r_[focal, focal, 0.5 * (np.array(size) - 1.0), np.zeros(5)], size, model)

    @classmethod
    def of(cls, K: ArrayLike, distortion: ArrayLike, size: tuple[int, int], model: str = PINHOLE) -> Lens:
        """From a camera matrix (3, 3) and up to eight coefficients k1 k2 p1 p2 k3 … k6, of a fisheye four k1 … k4."""
        K = np.asarray(K, dtype=float)
        d = np.zeros(8)
        given = np.asarray(distortion, dtype=float).ravel()
        d[: len(given)] = given
        return cls(np.r_[K[0, 0], K[1, 1], K[0, 2], K[1, 2], d[:5]], size, model, d[5:])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the values, (9,)."""
        return NAMES[self.model]

    @property
    def used(self) -> np.ndarray:
        """Which of the values this lens has, (9,) bool."""
        return np.arange(COUNT) < 4 + DISTORTIONS[self.model]

    @property
    def K(self) -> Array:
        """The camera matrix, (3, 3)."""
        fx, fy, cx, cy = self.values[:4]
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def project(self, X: ArrayLike) -> Array:
        """Pixels (..., 2) of points (..., 3) [m] in the camera's frame, z along its view."""
        X = np.asarray(X, dtype=float)
        if self.model == FISHEYE:
            return self._fisheye(X.reshape(-1, 3))[0].reshape(*X.shape[:-1], 2)
        xd, yd = _distort(X[..., 0] / X[..., 2], X[..., 1] / X[..., 2], self)[:2]
        fx, fy, cx, cy = self.values[:4]
        return np.stack([fx * xd + cx, fy * yd + cy], axis=-1)

    def linearise(self, X: Array) -> tuple[Array, Array, Array]:
        """Pixels (N, 2) of points (N, 3) [m], and their derivatives by the points (N, 2, 3) and by values (N, 2, 9)."""
        if self.model == FISHEYE:
            return self._fisheye(X)
        fx, fy, cx, cy = self.values[:4]
        z = 1.0 / X[:, 2]
        x, y = X[:, 0] * z, X[:, 1] * z
        xd, yd, r2, D = _distort(x, y, self)
        xx, xy, yy = _slopes(x, y, r2, D, self)
        zero = np.zeros_like(x)
        by_point = np.stack(
            [
                np.stack([fx * xx * z, fx * xy * z, -fx * z * (xx * x + xy * y)], axis=1),
                np.stack([fy * xy * z, fy * yy * z, -fy * z * (xy * x + yy * y)], axis=1),
            ],
            axis=1,
        )
        by_values = np.empty((len(X), 2, COUNT))
        over = r2 / _below(r2, self.below)
        u = (xd, zero, zero + 1.0, zero, x * over, x * over * r2, 2.0 * x * y, r2 + 2.0 * x * x, x * over * r2**2)
        v = (zero, yd, zero, zero + 1.0, y * over, y * over * r2, r2 + 2.0 * y * y, 2.0 * x * y, y * over * r2**2)
        for j, (a, b) in enumerate(zip(u, v, strict=True)):
            by_values[:, 0, j], by_values[:, 1, j] = (a, b) if j < 4 else (fx * a, fy * b)
        return np.stack([fx * xd + cx, fy * yd + cy], axis=1), by_point, by_values

    def rays(self, pixels: ArrayLike) -> Array:
        """Directions x, y at z = 1, (N, 2), that these pixels (N, 2) show, by Newton's method."""
        fx, fy, cx, cy = self.values[:4]
        goal = (np.asarray(pixels, dtype=float) - [cx, cy]) / [fx, fy]
        if self.model == FISHEYE:
            return self._fisheye_rays(goal)
        xy = goal.copy()
        for _ in range(_STEPS):
            x, y = xy.T
            xd, yd, r2, D = _distort(x, y, self)
            a, b, d = _slopes(x, y, r2, D, self)
            gap = goal - np.stack([xd, yd], axis=1)
            det = a * d - b * b
            det = np.where(np.abs(det) < 1e-6, 1.0, det)
            step = np.stack([d * gap[:, 0] - b * gap[:, 1], a * gap[:, 1] - b * gap[:, 0]], axis=1) / det[:, None]
            xy = xy + np.clip(step, -0.5, 0.5)
            if np.abs(step).max(initial=0.0) < 1e-13:
                break
        return xy

    def moved(self, change: ArrayLike) -> Lens:
        """The lens with its values changed by (9,)."""
        return replace(self, values=self.values + np.asarray(change))

    def _fisheye(self, X: Array) -> tuple[Array, Array, Array]:
        """As :meth:`linearise`."""
        fx, fy, cx, cy = self.values[:4]
        z = X[:, 2]
        rho = np.maximum(np.hypot(X[:, 0], X[:, 1]), _ON_AXIS * np.abs(z))
        angle = np.arctan2(rho, z)
        powers = angle[:, None] ** np.array([3, 5, 7, 9])
        bent = angle + powers @ self.values[4:8]
        slope = 1.0 + (powers * [3.0, 5.0, 7.0, 9.0] / angle[:, None]) @ self.values[4:8]
        ux, uy = X[:, 0] / rho, X[:, 1] / rho
        square = rho * rho + z * z
        # along the radius, across it, and along the axis
        out, across, back = slope * z / square, bent / rho, -slope * rho / square
        by_point = np.empty((len(X), 2, 3))
        by_point[:, 0, 0] = fx * (out * ux * ux + across * uy * uy)
        by_point[:, 0, 1] = fx * (out - across) * ux * uy
        by_point[:, 1, 0] = fy * (out - across) * ux * uy
        by_point[:, 1, 1] = fy * (out * uy * uy + across * ux * ux)
        by_point[:, 0, 2], by_point[:, 1, 2] = fx * back * ux, fy * back * uy
        xd, yd = bent * ux, bent * uy
        by_values = np.zeros((len(X), 2, COUNT))
        by_values[:, 0, 0], by_values[:, 1, 1] = xd, yd
        by_values[:, 0, 2] = by_values[:, 1, 3] = 1.0
        by_values[:, 0, 4:8], by_values[:, 1, 4:8] = fx * ux[:, None] * powers, fy * uy[:, None] * powers
        return np.stack([fx * xd + cx, fy * yd + cy], axis=1), by_point, by_values

    def _fisheye_rays(self, goal: Array) -> Array:
        """Directions x, y at z = 1 of distorted x, y (N, 2)."""
        bent = np.linalg.norm(goal, axis=1)
        angle = np.minimum(bent, _WIDEST)
        odd = np.array([3, 5, 7, 9])
        for _ in range(_STEPS):
            powers = angle[:, None] ** odd
            gap = bent - angle - powers @ self.values[4:8]
            slope = 1.0 + (odd * angle[:, None] ** (odd - 1)) @ self.values[4:8]
            step = gap / np.where(slope > 0.1, slope, 0.1)
            angle = np.clip(angle + np.clip(step, -0.3, 0.3), 0.0, _WIDEST)
            if np.abs(step).max(initial=0.0) < 1e-13:
                break
        stretch = np.where(bent > 1e-12, np.tan(angle) / np.maximum(bent, 1e-12), 1.0)
        return np.asarray(goal * stretch[:, None])


def _below(r2: Array, below: Array) -> Array:
    """What a rational polynomial divides by."""
    k4, k5, k6 = below
    return np.asarray(1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))


def _distort(x: Array, y: Array, lens: Lens) -> tuple[Array, Array, Array, Array]:
    """Distorted x and y, r², and the radial factor."""
    k1, k2, p1, p2, k3 = lens.values[4:]
    r2 = x * x + y * y
    D = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / _below(r2, lens.below)
    xd = x * D + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    yd = y * D + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return xd, yd, r2, D


def _slopes(x: Array, y: Array, r2: Array, D: Array, lens: Lens) -> tuple[Array, Array, Array]:
    """Derivatives of distorted x by x, of either by the other, and of distorted y by y."""
    (k1, k2, p1, p2, k3), (k4, k5, k6) = lens.values[4:], lens.below
    slope = k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2) - D * (k4 + r2 * (2.0 * k5 + 3.0 * k6 * r2))
    slope = slope / _below(r2, lens.below)
    return (
        D + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
        2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y,
        D + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
    )

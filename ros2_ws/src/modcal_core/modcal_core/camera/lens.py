"""The lens: a pinhole with radial and tangential distortion, or a fisheye, in OpenCV's numbers, and its derivatives.

Pinhole: with x = X / Z, y = Y / Z, r² = x² + y² and D = 1 + k1 r² + k2 r⁴ + k3 r⁶,

    x_d = x D + 2 p1 x y + p2 (r² + 2 x²)        u = fx x_d + cx
    y_d = y D + p1 (r² + 2 y²) + 2 p2 x y        v = fy y_d + cy

(Brown 1971). A rational polynomial divides D by 1 + k4 r² + k5 r⁴ + k6 r⁶, whose numbers stay as stated. Fisheye: with
θ the angle between ray and axis and r = tan θ,

    x_d = x / r · θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)          and y_d likewise

(Kannala and Brandt 2006, ROS's equidistant). Pixels count from the middle of the upper left one.
"""

from __future__ import annotations

from dataclasses import dataclass, field

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
_ON_AXIS = 1e-6  # of the depth; nearer the axis, a fisheye is a pinhole
# Of Newton's method, and how long one may be: three are enough near the middle, and so many reach 87° off the axis
_STEPS, _LONGEST = 40, 0.5
_ODD = np.array([3.0, 5.0, 7.0, 9.0])  # powers of the angle


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
        bent = self._bent((X[..., :2] / X[..., 2:]).reshape(-1, 2))[0]
        return np.asarray(bent * self.values[:2] + self.values[2:4]).reshape(*X.shape[:-1], 2)

    def linearise(self, X: Array) -> tuple[Array, Array, Array]:
        """Pixels (N, 2) of points (N, 3) [m], and their derivatives by the points (N, 2, 3) and by values (N, 2, 9)."""
        focal, over = self.values[:2], 1.0 / X[:, 2:]
        xy = X[:, :2] * over
        bent, by_xy, by_distortion = self._bent(xy)
        by_xy = focal[:, None] * by_xy * over[:, :, None]
        by_values = np.zeros((len(X), 2, COUNT))
        by_values[:, [0, 1], [0, 1]], by_values[:, [0, 1], [2, 3]] = bent, 1.0
        by_values[:, :, 4:] = focal[:, None] * by_distortion
        return bent * focal + self.values[2:4], np.concatenate([by_xy, -by_xy @ xy[:, :, None]], axis=2), by_values

    def rays(self, pixels: ArrayLike) -> Array:
        """Directions x, y at z = 1, (N, 2), that these pixels (N, 2) show."""
        goal = (np.asarray(pixels, dtype=float) - self.values[2:4]) / self.values[:2]
        xy = goal.copy()
        for _ in range(_STEPS):
            bent, by_xy, _ = self._bent(xy)
            by_xy[np.abs(np.linalg.det(by_xy)) < 1e-6] = np.eye(2)
            step = np.linalg.solve(by_xy, (goal - bent)[:, :, None])[:, :, 0]
            xy = xy + np.clip(step, -_LONGEST, _LONGEST)
            if np.abs(step).max(initial=0.0) < 1e-13:
                break
        return xy

    def _bent(self, xy: Array) -> tuple[Array, Array, Array]:
        """(distorted x, y (N, 2), their derivatives by x, y (N, 2, 2) and by the five of distortion (N, 2, 5))."""
        r2 = (xy**2).sum(axis=1)
        by = np.zeros((len(xy), COUNT - 4))
        if self.model == FISHEYE:
            r2 = np.maximum(r2, _ON_AXIS**2)
            r = np.sqrt(r2)
            angle = np.arctan(r)
            powers = angle[:, None] ** _ODD
            by[:, :4] = powers / r[:, None]
            stretch = angle / r + by[:, :4] @ self.values[4:8]
            along = (1.0 + (powers * _ODD / angle[:, None]) @ self.values[4:8]) / (1.0 + r2)
            slope = 0.5 * (along - stretch) / r2
        else:
            k1, k2, p1, p2, k3 = self.values[4:]
            k4, k5, k6 = self.below
            below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
            by[:, 0], by[:, 1], by[:, 4] = r2 / below, r2**2 / below, r2**3 / below
            stretch = 1.0 / below + by @ [k1, k2, 0.0, 0.0, k3]
            slope = k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2) - stretch * (k4 + r2 * (2.0 * k5 + 3.0 * k6 * r2))
            slope = slope / below
        by_xy = stretch[:, None, None] * np.eye(2) + 2.0 * slope[:, None, None] * xy[:, :, None] * xy[:, None]
        bent, by_values = stretch[:, None] * xy, by[:, None] * xy[:, :, None]
        if self.model == PINHOLE:
            x, y = xy.T
            by_values[:, 0, 2] = by_values[:, 1, 3] = 2.0 * x * y
            by_values[:, 0, 3], by_values[:, 1, 2] = r2 + 2.0 * x * x, r2 + 2.0 * y * y
            bent = bent + by_values[:, :, 2:4] @ [p1, p2]
            by_xy[:, 0, 0] += 2.0 * p1 * y + 6.0 * p2 * x
            by_xy[:, 1, 1] += 6.0 * p1 * y + 2.0 * p2 * x
            by_xy[:, [0, 1], [1, 0]] += (2.0 * p1 * x + 2.0 * p2 * y)[:, None]
        return bent, by_xy, by_values

"""What tracks that are no one joint share: types, and ways to write a plane path and a turn about its normal."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Path = tuple[Array, Rotation]  # positions (n, 3) [m] and rotations of the handle
Maker = Callable[[np.random.Generator, int], Path]
DEGREE = np.pi / 180.0


def about_z(angle: Array) -> Rotation:
    """Turns (n,) [rad] about the plane's normal."""
    return Rotation.from_rotvec(np.outer(angle, [0.0, 0.0, 1.0]))


def flat(x: Array, y: Array) -> Array:
    """Positions (n, 3) [m] in the plane."""
    return np.stack([x, y, np.zeros_like(x)], axis=1)

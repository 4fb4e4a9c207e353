"""Folding doors as a truth of their own: two leaves, the elbow where two circles meet; no code of the model under test."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


def folding(rng: np.random.Generator, width: float, handle: float, samples: int = 80, white: float = 1e-3,
            away: Callable[[Array], Array] | None = None) -> tuple[Array, Array]:  # fmt: skip
    """Positions (n, 3) and rotations (n, 3, 3) of a handle, somewhere in a room, with white noise [m; 5 mrad].

    The door is opened from about 6 to 75 degrees of its first leaf. away: a departure (n, 3) [m] by the path (n,).
    """
    end = 2.0 * width * np.cos(np.linspace(0.1, 1.3, samples))  # of the second leaf, on the rail
    elbow = np.stack([0.5 * end, np.sqrt(width**2 - 0.25 * end**2)], axis=1)
    guided = np.stack([end, np.zeros(samples)], axis=1)
    leaf = (elbow - guided) / width
    p = np.column_stack([guided + handle * leaf, np.zeros(samples)])
    turned = np.column_stack([np.zeros((samples, 2)), np.arctan2(leaf[:, 1], leaf[:, 0])])
    if away is not None:
        p = p + away(np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))]))
    world, hold = (Rotation.random(random_state=int(rng.integers(2**31))) for _ in range(2))
    seen = world.apply(p) + rng.uniform(-1.0, 1.0, 3) + rng.normal(0.0, white, (samples, 3))
    R = world * Rotation.from_rotvec(turned) * hold * Rotation.from_rotvec(rng.normal(0.0, 5e-3, (samples, 3)))
    return seen, R.as_matrix()

"""What images show of a target: corners with their numbers, where they are, and how well that is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.geometry.read_only import view
from modcal_core.geometry.so3 import Array


@dataclass(frozen=True)
class BoardView:
    """The corners of the target in one image.

    name: of the image. ids: numbers of the corners, (m,). pixels: (m, 2). cov: of each corner [px²], (m, 2, 2).
    sharpness: width of the edges [px], NaN where unknown. stamp: [s], NaN where unknown.
    """

    name: str
    ids: np.ndarray
    pixels: Array
    cov: Array
    sharpness: float = float("nan")
    stamp: float = float("nan")

    def __post_init__(self) -> None:
        for name in ("ids", "pixels", "cov"):
            object.__setattr__(self, name, view(getattr(self, name)))

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, rows: np.ndarray) -> BoardView:
        """The view with these corners only (mask or indices)."""
        return BoardView(self.name, self.ids[rows], self.pixels[rows], self.cov[rows], self.sharpness, self.stamp)


def whitening(cov: Array) -> Array:
    """Matrices L (m, 2, 2) that make errors of these covariances (m, 2, 2) white: L cov Lᵀ = 1."""
    return np.linalg.inv(np.linalg.cholesky(cov))

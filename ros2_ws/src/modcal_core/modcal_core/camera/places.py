"""How far the markers of a body are expected from where its drawing has them.

Each marker is glued on, or printed, a little elsewhere, and turned: three values of a point's place, six of a marker
whose corners are read. All of them moved as one body is a motion of the body, which the pose of the target is there
for. So in the units of their tolerances the six motions as a body are held, and what is left keeps full rank: the
target's frame is the one in which its markers' offsets add up to no motion. How large they are against the tolerances
is one of the sizes that the data decide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array

_HELD = 1e6  # times the information of the tolerances: the body's frame is then theirs to a thousandth of them
_RANK = 1e-9  # of the largest; a motion below it moves no marker, as a turn about the line through two points


@dataclass(frozen=True)
class PlacePrior:
    """apart, held: information of the markers' places (Z, Z) [1/m², 1/rad²], at the stated tolerance: of what they are
    off apart from each other, and of what they are off together.
    """

    apart: Array
    held: Array

    def information(self, size: float) -> Array:
        """Information matrix of the marker places, (Z, Z). size: scale of the offsets in units of the tolerances."""
        return np.asarray(self.apart / size**2 + self.held)


def place_prior(middles: Array, white: Array) -> PlacePrior:
    """The prior of K markers at these middles (K, 3) [m].

    white: takes the offsets of each, v = 3 or 6 values of its place, to units of its tolerances, (K, v, v), symmetric.
    """
    K, values = len(middles), white.shape[1]
    body = np.zeros((K, values, 6))
    body[:, :3, :3] = np.eye(3)
    body[:, :3, 3:] = -so3.hat(middles - middles.mean(axis=0))
    if values > 3:
        body[:, 3:, 3:] = np.eye(3)
    U, singular, _ = np.linalg.svd((white @ body).reshape(-1, 6), full_matrices=False)
    U = (white @ U[:, singular > _RANK * singular[0]].reshape(K, values, -1)).reshape(K * values, -1)
    together = U @ U.T
    every = np.zeros((K, values, K, values))
    every[np.arange(K), :, np.arange(K)] = white @ white
    return PlacePrior(every.reshape(len(U), len(U)) - together, _HELD * together)

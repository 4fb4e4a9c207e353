"""An articulation model: a folding door of two leaves of one width, the second of which runs along a rail.

The first leaf is hinged to the frame at the origin, the rail lies along x. When the first leaf stands at angle a from
the rail, the hinge between the leaves is at w (cos a, sin a), and the guided end of the second at 2 w cos a. A handle
on the second leaf, at a distance u from that end, goes along a quarter of an ellipse, its leaf turning the other way:

    x = (2 w − u) cos a,   y = u sin a,   turned by −a
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from modcal_core.articulation.models import ParametricModel, ShapeParameter

Array = NDArray[np.float64]


class FoldingDoor(ParametricModel):
    """Leaves of cupboards and wardrobes: 0.2 to 0.7 m wide, the handle somewhere on the outer half of the second."""

    name = "folding_door"
    parameters = (ShapeParameter("log_width", np.log(0.4), 0.3), ShapeParameter("handle_m", 0.15, 0.08, "m"))
    lower, upper = 0.0, 0.5 * np.pi
    unit = "rad"

    def pose(self, values: Array, a: Array) -> Array:
        """T_object_handle (n, 4, 4), the frame at the hinge of the first leaf."""
        width, u = np.exp(values[0]), values[1]
        c, s = np.cos(a), np.sin(a)
        T = np.tile(np.eye(4), (len(a), 1, 1))
        T[:, 0, 0], T[:, 0, 1], T[:, 0, 3] = c, s, (2.0 * width - u) * c
        T[:, 1, 0], T[:, 1, 1], T[:, 1, 3] = -s, c, u * s
        return T


MODEL = FoldingDoor()

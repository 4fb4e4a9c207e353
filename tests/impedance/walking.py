"""A path checked to its end."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_core.impedance.path_model import PathCheck, Reach
from modcal_core.robots.chain import Chain


def reach(chain: Chain, poses: Sequence[Array], q0: Array, **limits: float) -> Reach:
    """The joints for a path of poses (m, 4, 4) of the tip in the base, from a posture (n,), as far as it is reached."""
    walk = PathCheck(chain, poses, np.asarray(q0, dtype=float), **limits)
    while (done := walk.advance(100)) is None:
        pass
    return done

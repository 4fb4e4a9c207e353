"""Readings of one stop share what the arm does not repeat: they tell of the parameters what fewer readings would.

The sum of the residuals of a stop is as large as it is by chance where they are independent, and as many times larger
in square as they are where all are the same (the design effect; Kish 1965, *Survey sampling*, section 5.4).
"""

from __future__ import annotations

import numpy as np

from modcal_core.calibration.linearise import Linearised
from modcal_core.calibration.runs import independent_unit
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.returns import SAME
from modcal_core.measurements.samples import Samples


def has_shared_noise(samples: Samples) -> bool:
    """Whether some stop was read twice or more. In motion noise is another matter."""
    if samples.moving.any() or len(samples) < 2:
        return False
    q = samples.q[np.argsort(samples.stamps, kind="stable")]
    return bool((np.abs(np.diff(q, axis=0)).max(axis=1) <= SAME).any())


def shared_noise(samples: Samples, left: Linearised, row_weight: Array) -> float:
    """How many times more samples there are than independent ones, 1 or more, by what a fit leaves of them.

    row_weight: (3 N + 3 M,).
    """
    unit, N = independent_unit(samples), len(samples)
    weighed = left.residual * np.sqrt(row_weight)
    position, rotation = weighed[: 3 * N].reshape(3, -1), weighed[3 * N :].reshape(3, -1)
    square = float(weighed @ weighed)
    together = sum(
        float(np.sum(np.bincount(of, component) ** 2))
        for of, components in ((unit, position), (unit[samples.is_pose], rotation))
        for component in components
        if len(component)
    )
    return max(together / square, 1.0) if square > 0.0 else 1.0

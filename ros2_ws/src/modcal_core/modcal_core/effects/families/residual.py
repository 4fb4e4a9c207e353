"""What is left of every joint once causes are named: small curves of its position, and the side that it comes from.

None of them shows by itself, so none is looked for or named. Together they predict: each is held as small as the
samples make likely (:mod:`modcal_core.diagnosis.residual_curves`).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.family import FREE, Family, no_candidates
from modcal_core.effects.registry import both_signs, moving_joints
from modcal_core.effects.shapes import Shape

NAME = "residual"
# rad or m between the functions of a curve: as fine as two of UR5's and UR10's gears err, and four times that, for what
# errs slowly. How large each part is decides how smooth their sum is
STEPS = (0.1, 0.4)
STATIONS_PER_FUNCTION = 2.0  # of a curve; of fewer nearly all of its functions would stay at nothing, and cost time


def curves(drivers: Drivers) -> Iterator[Effect]:
    """Every joint that moved, with amplitudes of zero."""
    for j, name in moving_joints(drivers):
        low, high = float(drivers.samples.q[:, j].min()), float(drivers.samples.q[:, j].max())
        for step in STEPS:
            count = round((high - low) / step) + 3
            if drivers.samples.stations >= STATIONS_PER_FUNCTION * count:
                shape = Shape("spline", {"low": low, "high": high, "count": float(max(count, 4))})
                yield _nothing(Effect(NAME, name, AXIS, f"position:{name}", shape))
        if both_signs(drivers.samples.approach[:, j]):
            yield _nothing(Effect(NAME, name, AXIS, f"direction:{name}", Shape("linear")))


def _nothing(effect: Effect) -> Effect:
    return effect.started(np.zeros(effect.shape.size))


FAMILY = Family(NAME, no_candidates, complexity=lambda _: FREE, claimed=False)

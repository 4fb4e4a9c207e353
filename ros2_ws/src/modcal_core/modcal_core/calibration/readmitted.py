"""Rejected samples that no other sample speaks against: a learned curve is known there from rejected ones alone.

Geometry misses by far where a curve is large, and a fit begins from geometry. Where a recording has few stations, all
of them may then be rejected before the curve could bend to them, and what is left of it there is nobody's: it misses
them for ever, and they stay rejected. A wrong reading is one that its neighbours contradict; three that have no other
neighbours are to be fitted first and judged then.
"""

from __future__ import annotations

import numpy as np

from modcal_core.calibration.model import Model
from modcal_core.calibration.runs import consecutive
from modcal_core.measurements.samples import Samples

_LOST = 0.5  # of a function's squares, less of which is left to samples that count: the others then decide it
_NEIGHBOURS = 3  # rejected stations at one place are no chance (as in runs); one alone may be a wrong reading
_THERE = 0.1  # of a function's largest square, from which a station says something of it


def uncontradicted(model: Model, samples: Samples, rejected: np.ndarray) -> np.ndarray:
    """True for rejected samples that stand where curves of the model are known from rejected ones, (N,)."""
    out = np.zeros(len(samples), bool)
    curves = [effect for effect in model.effects if effect.shape.kind == "spline"]
    if not rejected.any() or not curves:
        return out
    drivers = model.drivers(samples)
    for effect in curves:
        square = effect.shape.basis(drivers.values(effect.driver, effect.lag)) ** 2
        whole = square.sum(axis=1)
        lost = square[:, ~rejected].sum(axis=1) < _LOST * whole
        for first, last in consecutive(lost & (whole > 0.0)):
            part = square[first:last]
            there = rejected & (part > _THERE * part.max()).any(axis=0)
            if len(np.unique(samples.station[there])) >= _NEIGHBOURS:
                out |= there
    return out

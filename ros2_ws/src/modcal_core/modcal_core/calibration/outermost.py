"""Whether geometry alone is the better model outside what was seen: asked of the recording's own outermost postures.

Both models are fitted to the inner postures, as far as curves depend on their joints, and judged on the outer fifth.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from modcal_core.calibration.cell import Cell
from modcal_core.calibration.fallback import curved_joints
from modcal_core.calibration.identify import FITTED, identify
from modcal_core.calibration.model import Model
from modcal_core.calibration.score import errors
from modcal_core.calibration.structure import ParameterChoice
from modcal_core.errors import ModcalError
from modcal_core.measurements.samples import Samples

_OUTER = 0.2  # share of the postures, as much as is held out of a usual recording
_MOST = 3000  # samples, for time
_DRAWN_IN = 25.0  # of the median square, so that no wrong reading decides


def geometry_is_better(full: Model, alone: Model, samples: Samples, choice: ParameterChoice, cell: Cell) -> bool:
    """Whether, of two models fitted to the inner postures, geometry alone misses the outer ones by less.

    full, alone: fitted to all samples. False where there are no curves, or the inner postures are too few.
    """
    curved = curved_joints(full.effects, full.chain.names)
    if not curved.any():
        return False
    if len(samples) > _MOST:
        samples = samples.select(np.linspace(0, len(samples) - 1, _MOST).astype(int))
    q = samples.q[:, curved]
    away = np.abs(q - 0.5 * (q.max(axis=0) + q.min(axis=0))) / np.maximum(np.ptp(q, axis=0), 1e-12)
    outer = away.max(axis=1)
    outside = outer > np.quantile(outer, 1.0 - _OUTER)
    inner, judged = samples.select(np.flatnonzero(~outside)), samples.select(np.flatnonzero(outside))
    fitted = partial(identify, samples=inner, parameters=choice.parameters, distances=cell.distances, tolerance=FITTED)
    try:
        missed = [errors(fitted(model).model, judged).position_norm ** 2 for model in (alone, full)]
    except (ModcalError, np.linalg.LinAlgError):
        return False
    most = _DRAWN_IN * float(np.median(missed[1]))
    geometry, curves = (float(np.minimum(square, most).mean()) for square in missed)
    return geometry < curves

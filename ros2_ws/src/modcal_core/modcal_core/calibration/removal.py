"""A model without some of its effects, everything else fitted again: by one step in closed form.

With θ the values taken away and C the covariance of all, the rest moves by C_re C_ee⁻¹ θ: there the quadratic about the
minimum is least among the models without them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.calibration.linearise import apply_deviations, deviations
from modcal_core.calibration.model import Model
from modcal_core.calibration.uncertainty import Uncertainty
from modcal_core.effects.effect import Effect, is_large_move
from modcal_core.geometry.so3 import Array


def without(model: Model, known: Uncertainty, gone: Sequence[int]) -> Model:
    """The model without the effects of these numbers. known: covariance of its parameters and effects' values."""
    if not len(gone):
        return model
    values, kept = values_without(model, known, gone)
    return apply_deviations(model, deviations(model, known.parameters, values)).with_effects(kept)


def values_without(model: Model, known: Uncertainty, gone: Sequence[int]) -> tuple[Array, tuple[Effect, ...]]:
    """By how much the parameters move, (P,) [m, rad], and the effects that are left, where those go."""
    P, effects = len(known.parameters), model.effects
    if any(is_large_move(effects[i]) for i in gone):  # no small step of the others stands in for it
        return np.zeros(P), tuple(e for i, e in enumerate(effects) if i not in set(gone))
    ends = P + np.cumsum([0, *(len(e.values) for e in effects)])
    values = np.concatenate([np.zeros(P), *(e.values for e in effects)])
    # their settings mean nothing without their amplitudes
    own = np.concatenate([np.arange(ends[i], ends[i] + len(effects[i].amplitudes)) for i in gone])
    C = known.covariance
    step = -C[:, own] @ np.linalg.lstsq(C[np.ix_(own, own)], values[own], rcond=1e-12)[0]
    values = values + step
    kept = [e.with_values(values[ends[i] : ends[i + 1]], e.std) for i, e in enumerate(effects) if i not in set(gone)]
    return values[:P], tuple(kept)

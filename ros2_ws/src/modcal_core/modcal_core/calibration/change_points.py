"""When exactly something happened: the moment of a step, sharpened by samples that the search for it did not use."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modcal_core.calibration.model import Model
from modcal_core.calibration.score import errors
from modcal_core.effects.effect import Effect
from modcal_core.measurements.samples import Samples

_AROUND = 12  # stations on either side of a step that are tried


def sharpened(model: Model, samples: Samples) -> Model:
    """The model with the moment of every step, and of every load that came, put between the stations that fit best."""
    effects = model.effects
    for i, effect in enumerate(effects):
        if effect.shape.kind in ("step", "until", "since"):
            effects = (*effects[:i], _sharpened(model, effects, i, samples), *effects[i + 1 :])
    return model if effects is model.effects else model.with_effects(effects)


def _sharpened(model: Model, effects: tuple[Effect, ...], i: int, samples: Samples) -> Effect:
    stamps = np.unique(samples.stamps)
    here = int(np.searchsorted(stamps, effects[i].shape.settings["at"]))
    gaps = [k for k in range(here - _AROUND, here + _AROUND + 1) if 0 < k < len(stamps)]
    near = samples.select(
        (samples.stamps >= stamps[max(gaps[0] - 1, 0)]) & (samples.stamps <= stamps[min(gaps[-1], len(stamps) - 1)])
    )
    lever = model.chain.reach()  # what a turn is worth, where it moves nothing
    best, least = effects[i], np.inf
    for k in sorted(gaps, key=lambda k: abs(k - here)):
        shape = effects[i].shape.with_settings({"at": float(0.5 * (stamps[k - 1] + stamps[k]))})
        moved = replace(effects[i], shape=shape)
        e = errors(model.with_effects((*effects[:i], moved, *effects[i + 1 :])), near)
        cost = float(np.sum(e.position_norm**2)) + lever**2 * float(np.sum(e.rotation_norm**2))
        if cost < least * (1.0 - 1e-9):
            best, least = moved, cost
    return best

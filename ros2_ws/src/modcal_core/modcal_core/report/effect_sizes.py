"""How large the effects of one entry are together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.calibration.model import Model
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.registry import family
from modcal_core.effects.sizes import Sizes, curve_sizes, unit_of
from modcal_core.measurements.samples import Samples
from modcal_core.robots.mechanism import Mechanism


def parameters(effects: Sequence[Effect], chain: Mechanism, companions: Sequence[Effect] = ()) -> Sizes:
    """Named sizes of the effects of one entry; later ones numbered. companions: curves that its first is one with."""
    out: Sizes = {}
    curves = [i for i, effect in enumerate(effects) if effect.direction == AXIS and effect.shape.kind == "spline"]
    for i, effect in enumerate(effects):
        sizes = family(effect.family).sizes(effect, chain)
        if companions and i in curves[:1]:
            sizes |= curve_sizes(effect, unit_of(effect, chain), companions)
        for name, quantity in sizes.items():
            out[name if i == 0 else f"{name}_{i + 1}"] = quantity
    return out


def at_tool(model: Model, effects: Sequence[int], samples: Samples) -> float:
    """RMS distance [m] by which the effects of these numbers together move the tool at the samples."""
    kept = tuple(e for i, e in enumerate(model.effects) if i not in set(effects))
    gap = model.predict_samples(samples)[:, :3, 3] - model.with_effects(kept).predict_samples(samples)[:, :3, 3]
    return float(np.sqrt(np.mean(np.sum(gap**2, axis=1))))

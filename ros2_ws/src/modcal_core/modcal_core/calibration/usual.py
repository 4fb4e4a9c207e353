"""What drivers and effects were while a calibration was recorded, to be kept with it."""

from __future__ import annotations

import numpy as np

from modcal_core.calibration.model import Model
from modcal_core.effects.driver_limits import Usual, averaged, outside_drivers
from modcal_core.measurements.samples import Samples

_MOVES = ("step", "until")
_HEARD = ("temperature:", "signal:")


def driver_ranges(model: Model, samples: Samples) -> dict[str, tuple[float, float]]:
    """Smallest and largest value, at the samples, of each temperature and signal that the model's effects go by."""
    at = model.circumstances(samples)
    names = {part for e in model.effects for part in outside_drivers(e) if part.startswith(_HEARD)}
    return {name: (float(x.min()), float(x.max())) for name in sorted(names) if len(x := at.driver(name))}


def usual_sizes(model: Model, samples: Samples) -> tuple[Usual | None, ...]:
    """For each effect its average, of a step its end, and what it costs to hold it there.

    None where no recording lacks its driver.
    """
    out: list[Usual | None] = []
    at, effects = model.circumstances(samples), model.effects
    for i, effect in enumerate(effects):
        if not outside_drivers(effect):
            out.append(None)
            continue
        basis = effect.shape.basis(at.driver(effect.driver, effect.lag))
        # what moved stays where it was in the end: between two places it never stood
        mean = basis[:, int(np.argmax(samples.stamps))] if effect.shape.kind in _MOVES else basis.mean(axis=1)
        without = model.with_effects((*effects[:i], averaged(effect, mean), *effects[i + 1 :]))
        gap = model.predict_samples(samples)[:, :3, 3] - without.predict_samples(samples)[:, :3, 3]
        out.append(Usual(mean, float(np.mean(np.sum(gap**2, axis=1)))))
    return tuple(out)

"""What drivers and effects were while a calibration was recorded, to be kept with it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration.model import Model
from modcal_core.effects.effect import STEPS, Effect
from modcal_core.effects.shapes import Shape
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples

OUTSIDE = (
    "effort",
    "following",
    "temperature",
    "signal",
    "time",
)  # kinds of drivers that postures and URDF do not tell
_HEARD = ("temperature:", "signal:")


@dataclass(frozen=True)
class TypicalDriver:
    """What an effect was while it was calibrated. mean: of its basis functions, (b,). cost: mean square [m²] by which
    the tool is off where the effect is held at that.
    """

    mean: Array
    cost: float


def outside_drivers(effect: Effect) -> tuple[str, ...]:
    """The parts of the effect's driver that a recording may lack."""
    return tuple(part for part in effect.driver.split(",") if part.partition(":")[0] in OUTSIDE)


def averaged(effect: Effect, mean: Array) -> Effect:
    """A constant effect of the same place and directions, as large as this one with its basis at the mean (b,)."""
    amplitudes = effect.amplitudes.reshape(-1, len(mean)) @ mean
    plain = replace(effect, driver="constant", shape=Shape("linear"))
    return plain.with_values(amplitudes)


def driver_ranges(model: Model, samples: Samples) -> dict[str, tuple[float, float]]:
    """Smallest and largest value, at the samples, of each temperature and signal that the model's effects go by."""
    drivers = model.drivers(samples)
    names = {part for e in model.effects for part in outside_drivers(e) if part.startswith(_HEARD)}
    return {name: (float(x.min()), float(x.max())) for name in sorted(names) if len(x := drivers.values(name))}


def typical_sizes(model: Model, samples: Samples) -> tuple[TypicalDriver | None, ...]:
    """For each effect its average, of a step its end, and what it costs to hold it there.

    None where no recording lacks its driver.
    """
    out: list[TypicalDriver | None] = []
    drivers, effects = model.drivers(samples), model.effects
    for i, effect in enumerate(effects):
        if not outside_drivers(effect):
            out.append(None)
            continue
        basis = effect.shape.basis(drivers.values(effect.driver, effect.lag))
        # what moved stays where it was in the end: between two places it never stood
        mean = basis[:, int(np.argmax(samples.stamps))] if effect.shape.kind in STEPS else basis.mean(axis=1)
        without = model.with_effects((*effects[:i], averaged(effect, mean), *effects[i + 1 :]))
        gap = model.predict_samples(samples)[:, :3, 3] - without.predict_samples(samples)[:, :3, 3]
        out.append(TypicalDriver(mean, float(np.mean(np.sum(gap**2, axis=1)))))
    return tuple(out)

"""Where a calibrated robot's tool is, at postures and beside whatever else they are known with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.calibration.model import Model
from modcal_core.effects import STEPS, DriverLimits, Effect, NominalArm, Shape, claimed, undelayed
from modcal_core.errors import BadRecording, BadTable, MissingDriver
from modcal_core.geometry import Array
from modcal_core.measurements import Samples
from modcal_core.robots import Mechanism

# --- What drivers and effects were while a calibration was recorded, to be kept with it

OUTSIDE = ("effort", "following", "temperature", "signal", "time")  # drivers that postures and URDF do not tell
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


def signals_of(effects: Sequence[Effect]) -> list[tuple[str, float]]:
    """Signals, with the lag that is undone, that effects which reports name follow in a way that no law tells.

    Of a temperature, and of a number that says how much a load is multiplied by, it is known how they go on.
    """
    return sorted({(e.driver.partition(",")[0], min(e.lag, 0.0)) for e in effects if claimed(e) and _is_signal(e)})


def _is_signal(effect: Effect) -> bool:
    return effect.driver.startswith("signal:")


def averaged(effect: Effect, mean: Array) -> Effect:
    """A constant effect of the same place and directions, as large as this one with its basis at the mean (b,)."""
    amplitudes = effect.amplitudes.reshape(-1, len(mean)) @ mean
    plain = replace(effect, driver="constant", shape=Shape("linear"))
    return plain.with_values(amplitudes)


def driver_ranges(model: Model, samples: Samples) -> dict[str, tuple[float, float]]:
    """Smallest and largest value, at the samples, of each temperature and signal that the model's effects go by, with
    the lag that an effect undoes.
    """
    drivers = model.drivers(samples)
    parts = [(part, min(e.lag, 0.0)) for e in model.effects for part in outside_drivers(e) if part.startswith(_HEARD)]
    seen = {undelayed(name, lag): drivers.values(name, lag) for name, lag in sorted({*parts})}
    return {name: (float(x.min()), float(x.max())) for name, x in seen.items() if len(x)}


def typical_sizes(model: Model, samples: Samples) -> tuple[TypicalDriver | None, ...]:
    """For each effect its average, of a step its end, and what it costs to hold it there.

    None where no recording lacks its driver.
    """
    out: list[TypicalDriver | None] = []
    drivers = model.drivers(samples)
    for i, effect in enumerate(model.effects):
        if not outside_drivers(effect):
            out.append(None)
            continue
        basis = effect.shape.basis(drivers.values(effect.driver, effect.lag))
        # what moved stays where it was in the end: between two places it never stood
        mean = basis[:, int(np.argmax(samples.stamps))] if effect.shape.kind in STEPS else basis.mean(axis=1)
        out.append(TypicalDriver(mean, cost_of_holding(model, i, mean, samples)))
    return tuple(out)


def cost_of_holding(model: Model, number: int, mean: Array, samples: Samples) -> float:
    """Mean square [m²] by which the tool is off where the effect with this number is held with its basis at a mean."""
    held = averaged(model.effects[number], mean)
    without = model.with_effects((*model.effects[:number], held, *model.effects[number + 1 :]))
    gap = model.predict_samples(samples)[:, :3, 3] - without.predict_samples(samples)[:, :3, 3]
    return float(np.mean(np.sum(gap**2, axis=1)))


def predict(
    model: Model, nominal: Mechanism, limits: DriverLimits, q: ArrayLike | Samples, frame: str | None = None
) -> Array:
    """Poses of the tool (N, 4, 4) [m] by a calibrated model; the rest as of
    :meth:`modcal_core.calibration.store.Calibration.predict`.

    nominal: what loads are computed from where the model has no arm of its own. limits: where its drivers stop.
    """
    samples = q.of_joints(model.chain.names) if isinstance(q, Samples) else _standing(model, q)
    names = samples.frames if frame is None and isinstance(q, Samples) else (frame or model.frames[0],)
    unknown = [name for name in names if name not in model.frames]
    if unknown:
        remedy = f"give one of {', '.join(model.frames)}"
        raise BadTable(f"frame {unknown[0]}", "is not in the calibration", remedy)
    index = np.array([model.frames.index(name) for name in names])
    at = index[samples.frame if len(names) == len(samples.frames) and frame is None else np.zeros(len(samples), int)]
    samples = replace(samples, frames=model.frames, frame=at)
    _require_drivers(model, samples)
    arm = replace(model.arm or NominalArm(nominal), limits=limits)
    return replace(model, arm=arm).predict_samples(samples)


def _standing(model: Model, q: ArrayLike) -> Samples:
    """Postures of an arm that stands still, of which nothing else is known."""
    chain = model.chain
    postures = np.array(q, dtype=float)
    if postures.ndim != 2 or postures.shape[1] != chain.n or not np.isfinite(postures).all():
        said = f"has shape {postures.shape}, or is not finite; (N, {chain.n}) is read"
        raise BadRecording("q", said, f"give one posture a row, in the order {', '.join(chain.names)}")
    return Samples(
        names=chain.names,
        frames=model.frames[:1],
        q=postures,
        stamps=np.full(len(postures), np.nan),
        reading=np.zeros((len(postures), 3)),
    )


def _require_drivers(model: Model, samples: Samples) -> None:
    """Raises MissingDriver unless all that the effects depend on is known at every sample."""
    for effect in model.effects:
        for part in outside_drivers(effect):
            kind, _, of = part.partition(":")
            known = {
                "time": lambda of: np.isfinite(samples.stamps).all(),
                "effort": lambda of: np.isfinite(samples.effort[:, samples.names.index(of)]).all(),
                "following": lambda of: np.isfinite(samples.following[:, samples.names.index(of)]).any(),
            }.get(kind, lambda of, part=part: any(track.name == part for track in samples.signals))
            if not known(of):
                remedy = "give Samples that carry it, or calibrate without the effect"
                raise MissingDriver(part, f"the effect {effect.label} depends on it and it is not given", remedy)

"""What of a frozen calibration a recording allows, on its own clock: effects without a driver are named with a cost.

Gravity stands in for measured effort where the arm's masses are known. Any other effect without its driver is held at
what it was on average, and so are effects of time where either recording has no clock. A calibration's own score is
judged in the same way, as another recording would use it.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import (
    Calibration,
    Cell,
    Model,
    averaged,
    cost_of_holding,
    outside_drivers,
    refit_cell,
    signals_of,
    usual_miss,
)
from modcal_core.effects import STEPS, Effect, NominalArm, undelayed
from modcal_core.effects.families import latency
from modcal_core.errors import NotEnoughData
from modcal_core.geometry import Array, combined
from modcal_core.hypotheses import LIMIT_OF_REACH
from modcal_core.measurements import Samples, spread_rows
from modcal_core.measurements.kinds import is_direct
from modcal_core.verdict.case import base_and_tool, derivatives, weights
from modcal_core.verdict.grounds import NotApplied

_SAID = 1e-4  # s; a shorter delay is undone in silence
_CLOCKED, _ROUNDS = 1500, 3  # samples that a delay is found from; iterations
_ASTRAY = 30.0  # squares of a reading's residual, in the noise's, that count half


def on_joints_clock(calibration: Calibration, samples: Samples) -> tuple[Samples, tuple[str, ...]]:
    """Samples whose readings in motion are on the joints' clock, for a delay is a recording's own; and what is said."""
    moving = samples.moving & np.isfinite(samples.velocity).all(axis=1)
    if samples.origin.undelayed or not moving.any() or not is_direct(samples.kinds):
        return samples, ()
    model, late = applicable(calibration, samples).model, np.zeros(len(samples.frames))
    model = model.with_effects(tuple(e for e in model.effects if e.family != latency.NAME))
    for f in np.unique(samples.frame[moving]).tolist():
        rows = np.flatnonzero(moving & (samples.frame == f))
        few = samples.select(rows[spread_rows(len(rows), _CLOCKED)])
        few = replace(few, frames=(samples.frames[f],), frame=np.zeros(len(few), int), sockets=())
        with suppress(NotEnoughData):
            for _ in range(_ROUNDS):
                more, missed = _late(model, _later(few, -late[f]))
                late[f] += more
            late[f] *= missed <= LIMIT_OF_REACH * model.chain.reach()  # else they are of no such arm
    said = tuple(
        f"Readings in {frame} were {1e3 * seconds:+.2f} ms late, by their motion; that was undone."
        for frame, seconds in zip(samples.frames, late, strict=True)
        if abs(seconds) > _SAID
    )
    samples = replace(samples, origin=replace(samples.origin, undelayed=bool(late.any())))
    return _later(samples, -(moving * late[samples.frame])[:, None]), said


def _later(samples: Samples, seconds: Array | float) -> Samples:
    """The same at the joints' positions of so much later, (N, 1) or all."""
    velocity = samples.velocity + seconds * samples.acceleration
    q = samples.q + seconds * np.nan_to_num(0.5 * (samples.velocity + velocity))
    return replace(samples, q=q, velocity=velocity)


def _late(model: Model, samples: Samples) -> tuple[float, float]:
    """By how much readings of a frame are late [s], to first order, whatever base and tool are; what they miss [m]."""
    fit = refit_cell(model, samples, Cell())
    late = fit.model.with_effects((*fit.model.effects, latency.late().started(np.zeros(1))))
    residual, J = derivatives(late, base_and_tool(late, True, True), samples)
    own = weights(fit.noise, samples)
    own = own / (1.0 + np.sum((residual * own) ** 2, axis=0) / _ASTRAY)
    columns = (J[[*range(12), -1]] * own).reshape(13, -1).T
    return float(combined(columns, (residual * own).ravel())[-1]), usual_miss(fit.model, samples)


@dataclass(frozen=True)
class Applied:
    """The calibrated model as this recording allows it, what was not applied, and sentences for a person."""

    model: Model
    not_applied: tuple[NotApplied, ...]
    notes: tuple[str, ...]


def applicable(calibration: Calibration, samples: Samples) -> Applied:
    """The calibrated model for these samples."""
    arm = replace(calibration.calibrated.arm or NominalArm(calibration.nominal.chain), limits=calibration.driver_limits)
    model = replace(calibration.calibrated, arm=arm)
    effects: list[Effect] = []
    left: list[NotApplied] = []
    stood_in: list[str] = []
    partly: list[str] = []
    for effect, typical in zip(model.effects, map(calibration.typical_of, range(len(model.effects))), strict=True):
        if effect.driver == "clock":  # how the clocks of its own recording went
            continue
        if samples.origin.undelayed and effect.family == latency.NAME:
            effects.append(effect.with_values(np.zeros(len(effect.values))))
            continue
        why, cost = _lacking(effect, calibration, samples), 0.0 if typical is None else 1e6 * typical.cost
        if why is None:
            effects.append(effect)
            for what, count in _gaps(effect, samples).items():
                if what == "effort" and arm.weighed:
                    partly.append(f"{effect.label} at {count} of {len(samples)} samples")
                    continue
                said = f"{count} of {len(samples)} samples carry no {what}"
                left.append(NotApplied(effect.label, said, cost * count / len(samples)))
        elif effect.driver.startswith("effort:") and arm.weighed:
            effects.append(_by_gravity(effect))
            stood_in.append(effect.label)
        else:
            if typical is not None:
                effects.append(averaged(effect, typical.mean))
            left.append(NotApplied(effect.label, why, cost))
    model = model.with_effects(tuple(effects))
    return Applied(model, tuple(left), (*_notes(left, stood_in, partly), *_limits_note(model, calibration, samples)))


def carried_over(calibration: Calibration, samples: Samples) -> Applied:
    """The calibrated model as the recording of another day gets it, and what that costs on these samples, its own.

    Nothing goes by the time of its own recording then: a drift stays where it ended, and is held at its average where
    rows have no times. What was moved stands where it was put last.
    """
    model, effects, left = calibration.calibrated, list(calibration.calibrated.effects), []
    drivers = model.drivers(samples)
    for i, effect in enumerate(model.effects):
        if "time" not in outside_drivers(effect) or effect.shape.kind in STEPS:
            continue
        basis = effect.shape.basis(drivers.values(effect.driver, effect.lag))
        ended = samples.clock and effect.driver == "time"
        held = basis[:, int(np.argmax(samples.stamps))] if ended else basis.mean(axis=1)
        effects[i] = averaged(effect, held)
        why = "another recording does not continue its " + ("course of time" if samples.clock else "order of rows")
        left.append(NotApplied(effect.label, why, 1e6 * cost_of_holding(model, i, held, samples)))
    notes = tuple(
        f"Another recording is predicted without {item.effect}, which costs {np.sqrt(item.cost_mm2):.3f} mm RMS here: "
        f"{item.why}. The held-out score has it, the claim and the verdict do not."
        for item in left
    )
    return Applied(model.with_effects(tuple(effects)), tuple(left), notes)


def _lacking(effect: Effect, calibration: Calibration, samples: Samples) -> str | None:
    """Why the effect cannot be applied to these samples, None where it can."""
    for part in outside_drivers(effect):
        kind, _, of = part.partition(":")
        if kind == "effort" and not np.isfinite(samples.effort[:, samples.names.index(of)]).any():
            return f"the joint states carry no effort of {of}"
        if kind == "following" and not np.isfinite(samples.following[:, samples.names.index(of)]).any():
            return f"no commanded positions of {of} are recorded"
        if kind == "time" and not calibration.clock:
            return "the stamps of the calibration's recording are an order of rows, not times"
        if kind == "time" and not samples.clock:
            return "the stamps of this recording are an order of rows, not times"
        if kind in ("temperature", "signal") and not _heard(part, samples):
            return f"the recording has no {kind} {of}"
    return None


def _gaps(effect: Effect, samples: Samples) -> dict[str, int]:
    """At how many samples the recording lacks what joints say that the effect goes by: effort, commanded positions."""
    out = {}
    for kind, what, rows in (
        ("effort", "effort", samples.effort),
        ("following", "commanded positions", samples.following),
    ):
        of = [part.partition(":")[2] for part in outside_drivers(effect) if part.startswith(f"{kind}:")]
        columns = [samples.names.index(joint) for joint in of]
        if columns and (lacking := int((~np.isfinite(rows[:, columns])).any(axis=1).sum())):
            out[what] = lacking
    return out


def _heard(name: str, samples: Samples) -> bool:
    return any(track.name == name and np.isfinite(track.values[:, 0]).sum() > 1 for track in samples.signals)


def _by_gravity(effect: Effect) -> Effect:
    """The effect by the weight that the actuator holds up, whose torque is the opposite."""
    linear = len(effect.amplitudes)
    values = np.r_[-effect.amplitudes, effect.values[linear:]]
    return replace(effect, driver=f"load:{effect.driver.partition(':')[2]}", values=values)


def _notes(left: list[NotApplied], stood_in: list[str], partly: list[str]) -> tuple[str, ...]:
    out = [
        f"Not applied: {item.effect}, because {item.why}; it was held at its average, which on the calibration's own "
        f"recording costs {np.sqrt(item.cost_mm2):.3f} mm RMS."
        for item in left
    ]
    if stood_in:
        out.append(f"Gravity replaces measured effort, which the recording lacks: {', '.join(stood_in)}.")
    if partly:
        out.append(f"Gravity replaces measured effort where joint states lack it: {', '.join(partly)}.")
    return tuple(out)


def _limits_note(model: Model, calibration: Calibration, samples: Samples) -> tuple[str, ...]:
    """Sentences where time, temperatures or signals go beyond what was recorded."""
    parts = {part for e in model.effects for part in outside_drivers(e)}
    beyond: list[str] = []
    continued: list[str] = []
    unknown: list[str] = []
    signals = {name for name, _ in signals_of(model.effects)}
    limits = calibration.driver_limits
    if "time" in parts and calibration.watched and (limits.time(samples.stamps) != samples.stamps).any():
        first, last = calibration.watched
        hours = max(float(samples.stamps.max()) - last, first - float(samples.stamps.min())) / 3600.0
        beyond.append(f"time ({hours:.1f} h away)")
    unlimited = replace(model, arm=replace(model.arm, limits=None)) if model.arm else model
    at = unlimited.drivers(samples)
    for name, lag in sorted({(part, min(e.lag, 0.0)) for e in model.effects for part in outside_drivers(e)}):
        if (key := undelayed(name, lag)) not in limits.ranges or not len(samples):
            continue
        x, (low, high) = at.values(name, lag), limits.ranges[key]
        said = f"{key.replace(':', ' of ', 1)} (seen {low:.3g} … {high:.3g}, here {x.min():.3g} … {x.max():.3g})"
        if (limits.value(name, lag, x) != x).any():
            (unknown if name in signals else beyond).append(said)
        elif x.min() < low or x.max() > high:
            continued.append(said)
    return (
        *([f"Effects are held beyond what was recorded: {', '.join(beyond)}."] if beyond else ()),
        *([f"Effects are continued beyond what was recorded: {', '.join(continued)}."] if continued else ()),
        *([f"Geometry alone counts beyond what was recorded: {', '.join(unknown)}."] if unknown else ()),
    )

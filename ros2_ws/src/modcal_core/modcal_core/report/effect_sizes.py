"""How large an effect is: named quantities with their units, and its shape over its driver."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.calibration.model import Model
from modcal_core.effects.candidates import WHOLE_CYCLES
from modcal_core.effects.effect import ACROSS, ALL, JOINTS, LENGTH, SHIFT, Effect
from modcal_core.effects.effect import AXIS as AXIS
from modcal_core.effects.registry import added_shape
from modcal_core.geometry.so3 import Array
from modcal_core.geometry.twists import DIRECTIONS
from modcal_core.measurements.samples import Samples
from modcal_core.robots.mechanism import Mechanism

Quantity = tuple[float, float, str]  # value, standard deviation, unit
_LINE = 0.5  # share of a curve's quick part that one line must make up before the curve is called a rhythm
_PERIODS = 3.0  # that the joint's range must hold for it
_CERTAIN = 3.0  # standard deviations that its amplitude must have
_POINTS = 4096


def parameters(effects: Sequence[Effect], chain: Mechanism) -> dict[str, Quantity]:
    """Named sizes of the effects of one entry; later ones are numbered."""
    out: dict[str, Quantity] = {}
    for i, effect in enumerate(effects):
        for name, quantity in _sizes(effect, chain).items():
            out[name if i == 0 else f"{name}_{i + 1}"] = quantity
    return out


def at_tool(model: Model, effects: Sequence[int], samples: Samples) -> float:
    """RMS distance [m] by which the effects of these numbers together move the tool at the samples."""
    kept = tuple(e for i, e in enumerate(model.effects) if i not in set(effects))
    gap = model.predict_samples(samples)[:, :3, 3] - model.with_effects(kept).predict_samples(samples)[:, :3, 3]
    return float(np.sqrt(np.mean(np.sum(gap**2, axis=1))))


def _sizes(effect: Effect, chain: Mechanism) -> dict[str, Quantity]:
    v, s, settings = effect.values, effect.std, effect.shape.settings
    unit = "m" if effect.direction in ("x", "y", "z", LENGTH, SHIFT) or _slides(effect, chain) else "rad"
    if effect.direction == JOINTS:
        return {"delay": (float(v[0]), float(s[0]), "s")}
    if effect.family == "joint_lag":
        return {"delay": (-float(v[0]), float(s[0]), "s")}
    if effect.family == "scale":
        return {"scale": (float(v[0]), float(s[0]), "1")}
    if effect.shape.kind == "double":
        first, second = _wave(v[:2], s[:2], unit), _wave(v[2:4], s[2:4], unit)
        cycles = (settings["cycles"], float(s[4]), "1")
        return {
            **first,
            "cycles_per_turn": cycles,
            "amplitude_twice": second["amplitude"],
            "phase_twice": second["phase"],
        }
    if effect.shape.kind in ("sine", "turn") and effect.direction == AXIS:
        return {**_wave(v, s, unit), "cycles_per_turn": (settings["cycles"], float(s[2]) if len(s) > 2 else 0.0, "1")}
    if effect.shape.kind == "spline" and effect.direction == AXIS:
        return curve_sizes(effect, unit)
    if effect.shape.kind == "since":
        return {"compliance_times_mass": (float(v[0]), float(s[0]), "kg rad/(N m)"), "at": (settings["at"], 0.0, "s")}
    if effect.family in ("compliance", "payload"):
        return _compliance(effect, unit)
    if effect.family == "backlash":
        return {"backlash": (2.0 * abs(float(v[0])), 2.0 * float(s[0]), unit)}
    if effect.family == "gear_ratio":
        return {"ratio_error": (float(v[0]), float(s[0]), "1")}
    if effect.family == "coupling":
        return {"coupling": (float(v[0]), float(s[0]), f"{unit}/{_unit_of_driver(effect, chain)}")}
    out = _components(effect, unit, chain)
    if effect.shape.kind in ("step", "until"):
        out["at"] = (settings["at"], 0.0, "s")
    if effect.shape.kind == "settle":
        out["time_constant"] = (settings["tau"], float(s[-1]), "s")
    if effect.shape.kind == "turn":
        out["cycles_per_turn"] = (settings["cycles"], 0.0, "1")
    if effect.lag:
        out["lag"] = (effect.lag, float(s[-1]), "s")
    if own := added_shape(effect.shape.kind):
        for name, std in zip(effect.refined, s[len(effect.amplitudes) :], strict=True):
            out[name] = (settings[name], float(std), own.refined[name].unit)
    return out


def _slides(effect: Effect, chain: Mechanism) -> bool:
    """Whether the effect moves along the axis of a joint that slides."""
    names = chain.names
    return effect.direction == AXIS and effect.place in names and not chain.revolute[names.index(effect.place)]


def _unit_of_driver(effect: Effect, chain: Mechanism) -> str:
    joint = effect.driver.partition(":")[2]
    return "m" if joint in chain.names and not chain.revolute[chain.names.index(joint)] else "rad"


def _wave(v: Array, s: Array, unit: str) -> dict[str, Quantity]:
    size = float(np.hypot(v[0], v[1]))
    std = float(np.hypot(v[0] * s[0], v[1] * s[1]) / max(size, 1e-300))
    return {
        "amplitude": (size, std, unit),
        "phase": (float(np.arctan2(v[1], v[0])), std / max(size, 1e-300), "rad"),
    }


def _compliance(effect: Effect, unit: str) -> dict[str, Quantity]:
    # an actuator's torque is the opposite of the load that it holds
    v, s = effect.values * (-1.0 if effect.driver.startswith("effort:") else 1.0), effect.std
    load = "N m" if unit == "rad" else "N"
    scale = effect.shape.settings["scale"] if effect.shape.kind == "hardening" else 1.0
    first = (float(v[0]) / scale, float(s[0]) / scale)
    if effect.driver.startswith("payload:"):  # a stiffness needs a mass, and none is known
        out: dict[str, Quantity] = {"compliance_times_mass": (*first, f"kg {unit}/({load})")}
    else:
        out = {"compliance": (*first, f"{unit}/({load})")}
        if first[0]:
            out["stiffness"] = (1.0 / abs(first[0]), first[1] / first[0] ** 2, f"{load}/{unit}")
    if effect.shape.kind == "hardening":
        out["hardening"] = (float(v[1] / v[0] ** 2), float(s[1] / v[0] ** 2), f"1/{unit}^2")
    if effect.shape.kind == "several":
        ratio = float(v[1] / v[0])
        spread = abs(ratio) * float(np.hypot(s[0] / v[0], s[1] / v[1]))
        out["payload"] = (ratio, spread, "kg")
    return out


def _components(effect: Effect, unit: str, chain: Mechanism) -> dict[str, Quantity]:
    """Amplitudes by direction; of several functions in one direction their root sum of squares."""
    per = _per_driver(effect, chain)
    names = component_names(effect)
    count = max(len(effect.amplitudes) // len(names), 1)
    out: dict[str, Quantity] = {}
    for i, name in enumerate(names):
        v = effect.amplitudes[i * count : (i + 1) * count]
        s = effect.std[i * count : (i + 1) * count]
        of = "m" if name in DIRECTIONS[:3] or unit == "m" else "rad"
        size = float(v[0]) if count == 1 else float(np.linalg.norm(v))
        out[name] = (size, float(np.linalg.norm(s)), of + per)
    return out


def _per_driver(effect: Effect, chain: Mechanism) -> str:
    """What an amplitude is per, as the end of a unit: nothing where the shape has no slope."""
    kind = effect.driver.partition(":")[0]
    if effect.shape.kind == "ramp":
        return "/s"
    if effect.shape.kind not in ("linear", "lagged"):
        return ""
    units = {"temperature": "/K", "signal": "/unit", "load": "/(N m)", "effort": "/(N m)", "moment": "/(N m)"}
    if kind == "position":
        return f"/{_unit_of_driver(effect, chain)}"
    return units.get(kind, "")


def component_names(effect: Effect) -> tuple[str, ...]:
    """The directions that an effect moves in by itself, each with amplitudes of its own."""
    return {ALL: DIRECTIONS, SHIFT: DIRECTIONS[:3], ACROSS: ("rx", "ry")}.get(effect.direction, (effect.direction,))


def curve(
    effects: tuple[Effect, ...], low: float, high: float, points: int, component: int = 0
) -> tuple[Array, Array, Array]:
    """What effects of one driver do together over a range of it: driver, size and its deviation, (points,) each.

    component: which of their directions, as in :func:`component_names`.
    """
    x = np.linspace(low, high, points)
    size, variance = np.zeros(points), np.zeros(points)
    for effect in effects:
        basis = effect.shape.basis(x)
        part = slice(component * len(basis), (component + 1) * len(basis))
        size += effect.amplitudes[part] @ basis
        variance += (effect.std[part] ** 2) @ basis**2
    return x, size, np.sqrt(variance)


def curve_sizes(effect: Effect, unit: str = "rad") -> dict[str, Quantity]:
    """RMS of a free shape, and how often a turn it repeats where one line stands out of its spectrum."""
    low, high = effect.shape.settings["low"], effect.shape.settings["high"]
    x, y, std = curve((effect,), low, high, _POINTS)
    y = y - y.mean()
    deviation = float(np.sqrt(np.mean(std**2)))
    out: dict[str, Quantity] = {"amplitude_rms": (float(np.sqrt(np.mean(y**2))), deviation, unit)}
    cycles = rhythm(x, y, deviation)
    if cycles is not None:
        out["cycles_per_turn"] = (cycles, float(np.pi / (x[-1] - x[0])), "1")
    return out


def rhythm(x: Array, y: Array, deviation: float = 0.0) -> float | None:
    """How often a turn a curve y over positions x (N,) [rad], evenly spaced, repeats; None where it does not.

    A line must make up half of what is left beyond the slow part, over three periods, by three deviations.
    """
    # slow parts are shared with the geometry; what repeats is looked for beyond them
    slow = np.stack([f(k * x) for k in range(WHOLE_CYCLES + 1) for f in (np.sin, np.cos)], axis=1)
    fast = y - slow @ np.linalg.lstsq(slow, y, rcond=1e-9)[0]
    power = np.abs(np.fft.rfft(fast * np.hanning(len(y)), 8 * len(y))) ** 2
    top = float((2.0 * np.pi * np.fft.rfftfreq(8 * len(y), x[1] - x[0]))[int(np.argmax(power))])
    line = np.stack([np.sin(top * x), np.cos(top * x)], axis=1)
    amplitudes = np.linalg.lstsq(line, fast, rcond=1e-9)[0]
    share = 1.0 - float(np.sum((fast - line @ amplitudes) ** 2)) / max(float(np.sum(fast**2)), 1e-300)
    periods = top * float(x[-1] - x[0]) / (2.0 * np.pi)
    sure = float(np.hypot(*amplitudes)) >= _CERTAIN * deviation
    return top if share >= _LINE and periods >= _PERIODS and sure else None

"""Sizes of an effect as named quantities with units."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.effects.curve import curve, rhythm
from modcal_core.effects.effect import ACROSS, ALL, AXIS, LENGTH, SHIFT, Effect
from modcal_core.effects.shapes import PERIODIC
from modcal_core.geometry.so3 import Array
from modcal_core.geometry.twists import DIRECTIONS
from modcal_core.robots.mechanism import Mechanism

Quantity = tuple[float, float, str]  # value, standard deviation, unit
Sizes = dict[str, Quantity]
_POINTS = 4096  # of a curve, from which its largest value is taken
_PER_DRIVER = {"temperature": "/K", "signal": "/unit", "load": "/(N m)", "effort": "/(N m)", "moment": "/(N m)"}


def sizes_of(effect: Effect, chain: Mechanism) -> Sizes:
    """What can be said of an effect by its directions and its shape alone.

    Along one axis a wave has an amplitude, a phase and its cycles a turn, a spline what its curve does; of all others
    each direction has a size, followed by the settings of the shape.
    """
    unit = unit_of(effect, chain)
    if effect.direction == AXIS and effect.shape.kind in PERIODIC:
        return _waves(effect, unit)
    if effect.direction == AXIS and effect.shape.kind == "spline":
        return curve_sizes(effect, unit)
    return {**_components(effect, unit, chain), **settings_of(effect)}


def value(effect: Effect, i: int = 0, factor: float = 1.0, unit: str = "1") -> Quantity:
    """One value of an effect times a factor, with its standard deviation."""
    return float(effect.values[i]) * factor, float(effect.std[i]) * abs(factor), unit


def settings_of(effect: Effect) -> Sizes:
    """The settings of an effect's shape that reports show: those that stay, then those that are fitted."""
    kind, settings = effect.shape.of_kind, effect.shape.settings
    fixed = {s.name or name: (settings[name], 0.0, s.unit) for name, s in kind.fixed.items()}
    std = effect.std[len(effect.amplitudes) :].tolist()
    fitted = zip(kind.refined.items(), std, strict=True)
    return {**fixed, **{s.name or name: (settings[name], float(d), s.unit) for (name, s), d in fitted}}


def unit_of(effect: Effect, chain: Mechanism) -> str:
    """m or rad: what its amplitudes are in, where it has one direction."""
    names = chain.names
    slides = effect.direction == AXIS and effect.place in names and not chain.revolute[names.index(effect.place)]
    return "m" if slides or effect.direction in ("x", "y", "z", LENGTH, SHIFT) else "rad"


def unit_of_driver(effect: Effect, chain: Mechanism) -> str:
    """m or rad: what the position of the joint that drives it is in."""
    joint = effect.driver.partition(":")[2]
    return "m" if joint in chain.names and not chain.revolute[chain.names.index(joint)] else "rad"


def component_names(effect: Effect) -> tuple[str, ...]:
    """The directions that an effect moves in by itself, each with amplitudes of its own."""
    return {ALL: DIRECTIONS, SHIFT: DIRECTIONS[:3], ACROSS: ("rx", "ry")}.get(effect.direction, (effect.direction,))


def curve_sizes(effect: Effect, unit: str = "rad", companions: Sequence[Effect] = ()) -> Sizes:
    """RMS of a free shape, and how often a turn it repeats where one line stands out of its spectrum. companions: other
    curves over the same driver, which it is one with.
    """
    low, high = effect.shape.settings["low"], effect.shape.settings["high"]
    x, y, std = curve((effect, *companions), low, high, _POINTS)
    y = y - y.mean()
    deviation = float(np.sqrt(np.mean(std**2)))
    out: Sizes = {"amplitude_rms": (float(np.sqrt(np.mean(y**2))), deviation, unit)}
    cycles = rhythm(x, y, deviation)
    if cycles is not None:
        out["cycles_per_turn"] = (cycles, float(np.pi / (x[-1] - x[0])), "1")
    return out


def _waves(effect: Effect, unit: str) -> Sizes:
    """Amplitude and phase of one wave, or of two of which the second repeats twice as often."""
    v, s = effect.values, effect.std
    out = {**_wave(v[:2], s[:2], unit), **settings_of(effect)}
    if len(effect.amplitudes) == 4:
        second = _wave(v[2:4], s[2:4], unit)
        out |= {"amplitude_twice": second["amplitude"], "phase_twice": second["phase"]}
    return out


def _wave(v: Array, s: Array, unit: str) -> Sizes:
    size = float(np.hypot(v[0], v[1]))
    std = float(np.hypot(v[0] * s[0], v[1] * s[1]) / max(size, 1e-300))
    return {"amplitude": (size, std, unit), "phase": (float(np.arctan2(v[1], v[0])), std / max(size, 1e-300), "rad")}


def _components(effect: Effect, unit: str, chain: Mechanism) -> Sizes:
    """Amplitudes by direction; of several functions in one direction their root sum of squares."""
    per = _per_driver(effect, chain)
    names = component_names(effect)
    count = max(len(effect.amplitudes) // len(names), 1)
    out: Sizes = {}
    for i, name in enumerate(names):
        v = effect.amplitudes[i * count : (i + 1) * count]
        s = effect.std[i * count : (i + 1) * count]
        of = "m" if name in DIRECTIONS[:3] or unit == "m" else "rad"
        size = float(v[0]) if count == 1 else float(np.linalg.norm(v))
        out[name] = (size, float(np.linalg.norm(s)), of + per)
    return out


def _per_driver(effect: Effect, chain: Mechanism) -> str:
    """What an amplitude is per, as the end of a unit: nothing where the shape has no slope."""
    if effect.shape.kind == "ramp":
        return "/s"
    if effect.shape.kind not in ("linear", "lagged"):
        return ""
    kind = effect.driver.partition(":")[0]
    if kind == "following":  # an angle per angle
        return f"/{unit_of_driver(effect, chain)}"
    return f"/{unit_of_driver(effect, chain)}" if kind == "position" else _PER_DRIVER.get(kind, "")

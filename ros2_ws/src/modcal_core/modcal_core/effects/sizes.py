"""Sizes of an effect as named quantities with units.

An effect gives its functions for whatever follows. Where only their sum is wanted, of the hundreds of functions of some
twenty curves four each are not zero at a posture (:func:`~modcal_core.effects.shapes.near_functions`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.effects.effect import ACROSS, ALL, AXIS, LENGTH, SHIFT, ZERO, Effect, axis_direction, place_index
from modcal_core.effects.shapes import PERIODIC, SPLINE_DEGREE, WHOLE_CYCLES, near_functions
from modcal_core.geometry import DIRECTIONS, Array
from modcal_core.robots import Mechanism

# --- The course of effects over what drives them, and whether it repeats

_LINE = 0.5  # share of a curve's quick part that one line must make up before the curve is called a rhythm
_PERIODS = 3.0  # that the joint's range must hold for it
_CERTAIN = 3.0  # standard deviations that its amplitude must have


def curve(
    effects: Sequence[Effect], low: float, high: float, points: int, component: int = 0
) -> tuple[Array, Array, Array]:
    """What effects of one driver do together over a range of it: driver, size and its deviation, (points,) each.

    component: which of their directions, as in :func:`~modcal_core.effects.sizes.component_names`.
    """
    x = np.linspace(low, high, points)
    size, variance = np.zeros(points), np.zeros(points)
    for effect in effects:
        basis = effect.shape.basis(x)
        part = slice(component * len(basis), (component + 1) * len(basis))
        size += effect.amplitudes[part] @ basis
        variance += (effect.std[part] ** 2) @ basis**2
    return x, size, np.sqrt(variance)


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
    return "m" if slides or effect.direction in ("x", "y", "z", LENGTH, SHIFT, ZERO) else "rad"


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
    if kind in ("position", "following"):  # of the latter an angle per angle
        return f"/{unit_of_driver(effect, chain)}"
    return _PER_DRIVER.get(kind, "")


# --- Curves about joints' axes, all at once

_PAD = SPLINE_DEGREE + 2  # functions before the first and behind the last one, which are nothing


@dataclass(frozen=True)
class AxisCurves:
    """Cubic curves of joints' positions that move joints along or about their axes, m of them.

    of: which effects of those given they are, (m,). joint: column of the position that each follows. place, direction:
    what it moves. low, step: first end of its range and the way from function to function. count: of its functions.
    amplitudes: (m, most functions and what stands before and behind them).
    """

    of: tuple[int, ...]
    joint: np.ndarray
    place: np.ndarray
    direction: np.ndarray
    low: Array
    step: Array
    count: np.ndarray
    amplitudes: Array

    @classmethod
    def among(cls, effects: Sequence[Effect], chain: Mechanism) -> AxisCurves:
        """The curves about joint axes among the effects."""
        of = tuple(i for i, effect in enumerate(effects) if _is_curve(effect, chain))
        chosen = [effects[i] for i in of]
        place = np.array([place_index(e.place, chain) for e in chosen], dtype=int)
        low, high, count = (np.array([e.shape.settings[k] for e in chosen]) for k in ("low", "high", "count"))
        amplitudes = np.zeros((len(of), int(count.max(initial=0)) + 2 * _PAD))
        for row, effect in zip(amplitudes, chosen, strict=True):
            row[_PAD : _PAD + len(effect.amplitudes)] = effect.amplitudes
        return cls(
            of,
            np.array([chain.names.index(e.driver.partition(":")[2]) for e in chosen], dtype=int),
            place,
            np.array([axis_direction(chain, k - chain.first_place) for k in place], dtype=int),
            low,
            (high - low) / (count - SPLINE_DEGREE),
            count.astype(int),
            amplitudes,
        )

    def __len__(self) -> int:
        return len(self.of)

    def functions(self, q: Array) -> tuple[np.ndarray, Array]:
        """Number of the first of each curve's four functions that are not zero at postures q (N, n), (m, N), from −4 to
        ``count`` + 1, and their values (4, m, N).
        """
        x = q.T[self.joint]
        return near_functions(x, self.low[:, None], self.step[:, None], self.count[:, None])

    def add_to(self, twists: dict[int, Array], q: Array) -> None:
        """Put their motions at postures q (N, n) into twists (6, N) by place."""
        if not self.of:
            return
        first, value = self.functions(q)
        rows = np.arange(len(self))[:, None]
        sizes = sum(part * self.amplitudes[rows, first + (_PAD + i)] for i, part in enumerate(value))
        for place, direction, size in zip(self.place.tolist(), self.direction.tolist(), sizes, strict=True):
            if place not in twists:
                twists[place] = np.zeros((6, len(q)))
            twists[place][direction] += size

    def columns(self, q: Array) -> list[tuple[slice, Array]]:
        """For each curve at one posture q (n,) which of its amplitudes count there, and what a unit of each moves."""
        if not self.of:
            return []
        first, value = self.functions(q[None])
        out = []
        for begin, count, functions in zip(first[:, 0].tolist(), self.count.tolist(), value[:, :, 0].T, strict=True):
            low, high = min(max(begin, 0), count), max(min(begin + len(functions), count), 0)
            out.append((slice(low, max(low, high)), functions[low - begin : max(low, high) - begin]))
        return out


def _is_curve(effect: Effect, chain: Mechanism) -> bool:
    kind, _, joint = effect.driver.partition(":")
    curve = effect.shape.kind == "spline" and effect.direction == AXIS and effect.lag == 0.0
    return curve and kind == "position" and joint in chain.names and len(effect.amplitudes) > 0

"""The course of effects over what drives them, and whether it repeats."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.effects.effect import Effect
from modcal_core.effects.shapes import WHOLE_CYCLES
from modcal_core.geometry.so3 import Array

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

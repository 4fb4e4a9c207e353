"""What repeats with the turns of a gear, a motor or an encoder: a wave in the joint's own position, or a whole curve.

A few whole cycles a turn come from encoders and eccentric gears; many, with a number that is found, from the teeth or
the wave of a gear. Where the recording is dense enough the whole curve is drawn, whatever it is made of.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.family import USUAL, Family, ReportEntry, complexity_of_joint, in_words
from modcal_core.effects.registry import moving_joints
from modcal_core.effects.shapes import WHOLE_CYCLES, Shape
from modcal_core.geometry import Array

NAME = "gear_harmonic"
MAX_CYCLES = 400.0  # a turn: twice a ratio of 200
FINE_STEP = 0.05  # rad between the functions of a curve, which needs a dense recording
STATIONS_PER_FUNCTION = 6  # of a curve so fine; with fewer it follows the noise of single stations
# Cycles between neighbours in the search: with 0.3 periods over the joint's range a wave halfway between two loses 7 %
# of its square (sinc² of 0.15); never finer or coarser than the other two, for time and for narrow ranges
_OF_A_PERIOD, _FINEST, _COARSEST = 0.3, 0.15, 0.5
_FIRST = WHOLE_CYCLES + 1.0  # of the search, above the whole cycles that are asked for by themselves
_REMEMBERED = 16  # joints whose waves are kept, a megabyte each: of the two arms that a process is asked about by turns


def candidates(drivers: Drivers) -> Iterator[Effect]:
    """Every joint that turned, with every number of cycles that its range resolves; then whole curves."""
    for j, name in moving_joints(drivers):
        if drivers.arm.chain.revolute[j]:
            yield from _waves(name, _step(float(np.ptp(drivers.samples.q[:, j]))))
    for j, name in moving_joints(drivers):
        low, high = float(drivers.samples.q[:, j].min()), float(drivers.samples.q[:, j].max())
        count = round((high - low) / FINE_STEP) + 3
        if drivers.arm.chain.revolute[j] and drivers.samples.stations > STATIONS_PER_FUNCTION * count:
            shape = Shape("spline", {"low": low, "high": high, "count": float(count)})
            yield Effect(NAME, name, AXIS, f"position:{name}", shape)


@lru_cache(maxsize=_REMEMBERED)
def _waves(joint: str, step: float) -> tuple[Effect, ...]:
    """Waves of a joint with cycles at these spacings; the same two thousand for every scan of an arm."""
    out = list(whole(joint, WHOLE_CYCLES))
    for cycles in _grid(step).tolist():
        out.append(_wave(joint, "sine", cycles))
        if cycles <= 0.5 * MAX_CYCLES:  # strain wave gears err twice in each turn of their wave as well
            out.append(_wave(joint, "double", cycles))
    return tuple(out)


def whole(joint: str, most: int) -> Iterator[Effect]:
    """Waves of 1, 2, … ``most`` cycles a turn."""
    for cycles in range(1, most + 1):
        yield _wave(joint, "turn", float(cycles))


def wave(joint: str, cycles: float, double: bool = False) -> Effect:
    """A wave of this joint without a size, its cycles to be fitted. double: with one of twice as many cycles."""
    effect = _wave(joint, "double" if double else "sine", cycles)
    return effect.started(np.zeros(effect.shape.size))


def cycle_grid(joint_range: float) -> Array:
    """Cycles a turn, close enough that none is missed over this range [rad]."""
    return _grid(_step(joint_range))


def _step(joint_range: float) -> float:
    """Spacing of the cycles for a range [rad]: one of two dozen values."""
    step = float(np.clip(_OF_A_PERIOD * 2.0 * np.pi / joint_range, _FINEST, _COARSEST))
    return float(_FIRST / np.ceil(_FIRST / step))  # so that all are multiples of it: a scan sums them by one FFT


def _grid(step: float) -> Array:
    return np.asarray(np.arange(round(_FIRST / step), int(np.ceil(MAX_CYCLES / step)) + 1) * step, dtype=float)


def complexity(effect: Effect) -> int:
    """A gear's curve is preferred to any other free shape: teeth make one."""
    return USUAL if effect.shape.kind == "spline" else complexity_of_joint(effect)


def sentence(entry: ReportEntry) -> str:
    """How often a turn and how much by its largest line that is determined, or the RMS of a curve and its rhythm."""
    sizes = entry.sizes
    if "amplitude" in sizes:
        return _lines_in_words(entry)
    size, _, unit = sizes["amplitude_rms"]  # its deviation is that of single points, not of their RMS
    said = f"{entry.place} has an error of {in_words((1e3 * size, 0.0, f'm{unit}'))} RMS"
    if "cycles_per_turn" in sizes:
        return f"{said} that repeats about {sizes['cycles_per_turn'][0]:.3g} times a turn"
    return f"{said}, a curve over the joint's position"


def _lines_in_words(entry: ReportEntry) -> str:
    """The largest line whose size is determined. Two lines close to each other, or one that is hardly shorter than the
    joint's range, may be of any size against what else the model has: such a size is no fact of the gear.
    """
    lines = dict(_lines(entry))
    firm = [name for name in lines if entry.determined(name)]
    error = f"{entry.place}'s gear or encoder error"
    if not firm:
        return f"{error} varies with the joint's position; these stations do not determine the size of any line of it"
    largest = max(firm, key=lambda name: entry.sizes[name][0])
    more = f", with {len(firm) - 1} more such lines" if len(firm) > 1 else ""
    loose = len(lines) - len(firm)
    which = "one other" if loose == 1 else f"{loose} others"
    others = f"; of {which} these stations do not determine the size" if loose else ""
    return f"{error} repeats {lines[largest]:.4g} times a turn with {entry.thousandths(largest)}{more}{others}"


def _lines(entry: ReportEntry) -> Iterator[tuple[str, float]]:
    """Names of all amplitudes, with how often a turn each repeats."""
    for name, (cycles, _, _) in entry.sizes.items():
        if name.startswith("cycles_per_turn"):
            end = name.removeprefix("cycles_per_turn")
            for which, factor in (("amplitude", 1.0), ("amplitude_twice", 2.0)):
                if f"{which}{end}" in entry.sizes:
                    yield f"{which}{end}", factor * cycles


def _wave(joint: str, kind: str, cycles: float) -> Effect:
    return Effect(NAME, joint, AXIS, f"position:{joint}", Shape(kind, {"cycles": cycles}))


FAMILY = Family(NAME, candidates, complexity=complexity, sentence=sentence)

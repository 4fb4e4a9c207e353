"""A joint that rests on one side of its backlash or the other: by where it came from, or by the sign of its load."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.family import Family, ReportEntry, complexity_of_joint
from modcal_core.effects.registry import both_signs, loads
from modcal_core.effects.shapes import Shape
from modcal_core.effects.sizes import Sizes, unit_of, value
from modcal_core.robots import Mechanism

NAME = "backlash"
_UNDECIDED = 0.05  # of the usual load, below which its sign is not sure


def candidates(drivers: Drivers) -> Iterator[Effect]:
    """Every joint that came from both sides, and every one whose load changes its sign."""
    for j, name in enumerate(drivers.arm.chain.names):
        if both_signs(drivers.samples.approach[:, j]):
            yield Effect(NAME, name, AXIS, f"direction:{name}", Shape("linear"))
        for driver, load in loads(drivers, j).items():
            if both_signs(load):
                yield Effect(NAME, name, AXIS, driver, Shape("sign"))


def of_tool(joint: str, direction: str) -> Effect:
    """A loose tool, which rests on one side or the other by what a mass at the tip does to a joint."""
    return Effect(NAME, "tool", direction, f"payload:{joint}", Shape("sign"))


def sizes(effect: Effect, chain: Mechanism) -> Sizes:
    """The whole width; the amplitude is half of it, to either side."""
    size, std, unit = value(effect, 0, 2.0, unit_of(effect, chain))
    return {"backlash": (abs(size), std, unit)}


def sentence(entry: ReportEntry) -> str:
    """The width, and what decides on which side the joint rests."""
    return f"{entry.place} has {entry.thousandths('backlash')} of backlash, taken up by {entry.of_driver}"


def certain(effect: Effect, drivers: Drivers) -> np.ndarray:
    """False where the joint has not moved or is hardly loaded: it may then rest on either side."""
    side = drivers.values(effect.driver)
    return np.asarray(np.abs(side) > _UNDECIDED * np.sqrt(np.mean(side**2)))


FAMILY = Family(NAME, candidates, complexity=complexity_of_joint, sizes=sizes, sentence=sentence, certain=certain)

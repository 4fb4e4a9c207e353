"""A joint that moves along with another one, as wrists do whose gears lie within each other."""

from __future__ import annotations

from collections.abc import Iterator

from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.family import Family, ReportEntry
from modcal_core.effects.registry import moving_joints
from modcal_core.effects.shapes import Shape
from modcal_core.effects.sizes import Sizes, unit_of, unit_of_driver, value
from modcal_core.robots import Mechanism

NAME = "coupling"


def candidates(drivers: Drivers) -> Iterator[Effect]:
    """Every joint, with every other one that moved."""
    for _, driver in moving_joints(drivers):
        for name in drivers.arm.chain.names:
            if name != driver:
                yield Effect(NAME, name, AXIS, f"position:{driver}", Shape("linear"))


def sizes(effect: Effect, chain: Mechanism) -> Sizes:
    """How far it moves per unit of the other."""
    return {"coupling": value(effect, 0, 1.0, f"{unit_of(effect, chain)}/{unit_of_driver(effect, chain)}")}


def sentence(entry: ReportEntry) -> str:
    """The other joint, and how much."""
    size, _, unit = entry.sizes["coupling"]
    return f"{entry.place} moves with {entry.driver.partition(':')[2]} by {1e6 * size:.0f} ppm ({size:.2e} {unit})"


FAMILY = Family(NAME, candidates, sizes=sizes, sentence=sentence)

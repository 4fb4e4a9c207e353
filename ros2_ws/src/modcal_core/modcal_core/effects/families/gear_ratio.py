"""A joint that turns by a little more or less than it reports: a wrong ratio."""

from __future__ import annotations

from collections.abc import Iterator

from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.family import Family, ReportEntry, complexity_of_joint
from modcal_core.effects.registry import moving_joints
from modcal_core.effects.shapes import Shape
from modcal_core.effects.sizes import Sizes, value
from modcal_core.robots import Mechanism

NAME = "gear_ratio"


def candidates(drivers: Drivers) -> Iterator[Effect]:
    """Every joint that moved."""
    for _, name in moving_joints(drivers):
        yield Effect(NAME, name, AXIS, f"position:{name}", Shape("linear"))


def sizes(effect: Effect, _: Mechanism) -> Sizes:
    """The share by which it turns too far."""
    return {"ratio_error": value(effect)}


def sentence(entry: ReportEntry) -> str:
    """The share in millionths."""
    return f"{entry.place} turns by {1e6 * entry.sizes['ratio_error'][0]:.0f} ppm more than it reports"


FAMILY = Family(NAME, candidates, complexity=complexity_of_joint, sizes=sizes, sentence=sentence)

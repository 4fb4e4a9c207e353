"""A tracker whose metre is not a metre."""

from __future__ import annotations

from collections.abc import Iterator

from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import RADIAL, Effect
from modcal_core.effects.family import Family, ReportEntry
from modcal_core.effects.shapes import Shape
from modcal_core.effects.sizes import Sizes, value
from modcal_core.robots import Mechanism

NAME = "scale"


def candidates(_: Drivers) -> Iterator[Effect]:
    """The scale of the tracker, the only candidate."""
    yield Effect(NAME, "tracker", RADIAL, "reading", Shape("linear"))


def sizes(effect: Effect, _: Mechanism) -> Sizes:
    """The share by which readings are too long."""
    return {"scale": value(effect)}


def sentence(entry: ReportEntry) -> str:
    """The share in millionths."""
    return f"the tracker's metre is off by {1e6 * entry.sizes['scale'][0]:.0f} ppm"


FAMILY = Family(NAME, candidates, sizes=sizes, sentence=sentence)

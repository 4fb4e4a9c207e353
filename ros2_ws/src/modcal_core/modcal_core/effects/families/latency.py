"""Readings that come late: all joints have moved on by their speed times one delay."""

from __future__ import annotations

from collections.abc import Iterator

from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import JOINTS, Effect
from modcal_core.effects.family import Family, ReportEntry
from modcal_core.effects.registry import in_motion
from modcal_core.effects.shapes import Shape
from modcal_core.effects.sizes import Sizes, value
from modcal_core.robots import Mechanism

NAME = "latency"


def candidates(drivers: Drivers) -> Iterator[Effect]:
    """One, where readings were taken in motion."""
    if in_motion(drivers):
        yield late()


def late() -> Effect:
    """Readings that are late; its amplitude is the delay [s]."""
    return Effect(NAME, "tracker", JOINTS, "velocity", Shape("linear"))


def sizes(effect: Effect, _: Mechanism) -> Sizes:
    """The delay."""
    return {"delay": value(effect, 0, 1.0, "s")}


def sentence(entry: ReportEntry) -> str:
    """The delay in milliseconds."""
    return f"readings are {1e3 * entry.sizes['delay'][0]:.2f} ms late"


FAMILY = Family(NAME, candidates, sizes=sizes, sentence=sentence)

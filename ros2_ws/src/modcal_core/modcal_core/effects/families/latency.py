"""Readings that come late: all joints have moved on by their speed times a delay, which may grow with time.

Two clocks drift apart by some hundred millionths where nothing disciplines them.
"""

from __future__ import annotations

from collections.abc import Iterator

from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import JOINTS, Effect
from modcal_core.effects.family import PLAIN, USUAL, Family, ReportEntry
from modcal_core.effects.registry import in_motion, span
from modcal_core.effects.shapes import Shape
from modcal_core.effects.sizes import Sizes, value
from modcal_core.robots import Mechanism

NAME = "latency"


def candidates(drivers: Drivers) -> Iterator[Effect]:
    """A delay, and one that grows, where readings were taken in motion."""
    within = span(drivers, "clock")
    if not in_motion(drivers):
        return
    yield late()
    if within is not None and drivers.samples.clock:
        yield Effect(NAME, "tracker", JOINTS, "clock", Shape("ramp", {"since": 0.5 * sum(within)}))


def late() -> Effect:
    """Readings that are late; its amplitude is the delay [s]."""
    return Effect(NAME, "tracker", JOINTS, "velocity", Shape("linear"))


def complexity(effect: Effect) -> int:
    """A constant delay is plainer than one that grows."""
    return PLAIN if effect.driver == "velocity" else USUAL


def sizes(effect: Effect, _: Mechanism) -> Sizes:
    """The delay, or how fast it grows."""
    if effect.driver == "clock":
        return {"drift": value(effect)}
    return {"delay": value(effect, 0, 1.0, "s")}


def sentence(entry: ReportEntry) -> str:
    """The delay in milliseconds, or the drift in millionths."""
    if "drift" in entry.sizes:
        size = entry.sizes["drift"][0]
        return f"the clock of the readings drifts against that of the joints by {1e6 * size:.0f} ppm"
    return f"readings are {1e3 * entry.sizes['delay'][0]:.2f} ms late"


FAMILY = Family(NAME, candidates, complexity=complexity, sizes=sizes, sentence=sentence)

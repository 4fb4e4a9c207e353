"""Readings that come late: all joints have moved on by their speed times a delay, which may grow or jump with time.

Two clocks drift apart by some hundred millionths where nothing disciplines them, and jump where one is set.
"""

from __future__ import annotations

from collections.abc import Iterator

from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import JOINTS, Effect
from modcal_core.effects.family import PLAIN, USUAL, Family, ReportEntry
from modcal_core.effects.registry import breaks, in_motion, span
from modcal_core.effects.shapes import Shape
from modcal_core.effects.sizes import Sizes, settings_of, value
from modcal_core.robots import Mechanism

NAME = "latency"


def candidates(drivers: Drivers) -> Iterator[Effect]:
    """One delay, one that grows, and one that was another until some time, where readings were taken in motion."""
    within = span(drivers)
    if not in_motion(drivers):
        return
    yield late()
    if within is not None and drivers.samples.clock:
        yield late(Shape("ramp", {"since": sum(within) / 2.0}))
        for time in breaks(drivers).tolist():
            yield late(Shape("until", {"at": time}))


def late(course: Shape | None = None) -> Effect:
    """Readings that are late; its amplitude is the delay [s], or what its course over time is multiplied by."""
    if course is None:
        return Effect(NAME, "tracker", JOINTS, "velocity", Shape("linear"))
    return Effect(NAME, "tracker", JOINTS, "clock", course)


def complexity(effect: Effect) -> int:
    """A constant delay is plainer than one that changes."""
    return PLAIN if effect.driver == "velocity" else USUAL


def sizes(effect: Effect, _: Mechanism) -> Sizes:
    """The delay; how fast it grows; or by how much it changed, and when."""
    if effect.shape.kind == "ramp":
        return {"drift": value(effect)}
    if effect.shape.kind == "until":
        return {"jump": value(effect, 0, 1.0, "s"), **settings_of(effect)}
    return {"delay": value(effect, 0, 1.0, "s")}


def sentence(entry: ReportEntry) -> str:
    """The delay in milliseconds, or what the clock did."""
    if "delay" in entry.sizes:
        return f"readings are {1e3 * entry.sizes['delay'][0]:.2f} ms late"
    if "drift" in entry.sizes:
        size = entry.sizes["drift"][0]
        return f"the clock of the readings drifts against that of the joints by {1e6 * size:.0f} ppm"
    size, at = entry.sizes["jump"][0], entry.sizes["at"][0]
    return f"the clock of the readings jumped by {1e3 * size:.2f} ms (stamp {at:.1f} s)"


FAMILY = Family(NAME, candidates, complexity=complexity, sizes=sizes, sentence=sentence)

"""What moves slowly with time: steadily, by settling at the foot of arm or tracker, or along any slow curve."""

from __future__ import annotations

from collections.abc import Iterator

from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import Effect
from modcal_core.effects.family import Family, over_time
from modcal_core.effects.registry import base_and_tool, growing, span, warm_ups
from modcal_core.effects.shapes import Shape

NAME = "drift"
DEGREE = 4.0  # of a slow curve


def candidates(drivers: Drivers) -> Iterator[Effect]:
    """All that may grow or creep, base and tool: steadily; base and tool settling; then any slow course."""
    within = span(drivers)
    if within is None:
        return
    everything = [*growing(drivers), *base_and_tool(drivers)]
    for place, direction in everything:
        yield drifting(place, direction, Shape("ramp", {"since": within[0]}))
        for shape in warm_ups(drivers) if place in ("base", "tool") else ():
            yield drifting(place, direction, shape)
    for place, direction in everything:
        yield drifting(place, direction, slow_curve(*within))


def drifting(place: str, direction: str, shape: Shape) -> Effect:
    """A place that moves with time in this way."""
    return Effect(NAME, place, direction, "time", shape)


def slow_curve(low: float, high: float) -> Shape:
    """Any slow course between two stamps [s]."""
    return Shape("polynomial", {"degree": DEGREE, "low": low, "high": high})


FAMILY = Family(NAME, candidates, sentence=over_time)

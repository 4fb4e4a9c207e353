"""What follows a recorded temperature, at once or with a lag: links, joints, base, tool, the tracker's metre; and links
and joints that warm up while nobody measures.
"""

from __future__ import annotations

from collections.abc import Iterator

from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import RADIAL, Effect
from modcal_core.effects.family import PLAIN, Family, complexity_of_shape, over_time
from modcal_core.effects.registry import base_and_tool, growing, signals, warm_ups
from modcal_core.effects.shapes import SLOWEST, Shape

NAME = "thermal"
LAGS = (-SLOWEST, -120.0, -60.0, -30.0, 0.0, 30.0, 60.0, 120.0, 240.0, 480.0)  # s


def candidates(drivers: Drivers) -> Iterator[Effect]:
    """All of these by each temperature with each lag; and what may grow by warming up since the beginning."""
    temperatures, courses = signals(drivers, temperatures=True), warm_ups(drivers)
    warm = growing(drivers)
    for place, direction in (*warm, *base_and_tool(drivers), ("tracker", RADIAL)):
        for name in temperatures:
            for lag in LAGS:
                shape = Shape("lagged", {"lag": lag}) if lag else Shape("linear")
                yield Effect(NAME, place, direction, name, shape)
    for place, direction in warm:
        for shape in courses:
            yield Effect(NAME, place, direction, "time", shape)


def complexity(effect: Effect) -> int:
    """What was measured is plainer than the passing of time."""
    measured = effect.driver.startswith("temperature:") and not effect.shape.is_free
    return PLAIN if measured else complexity_of_shape(effect)


FAMILY = Family(NAME, candidates, complexity=complexity, sentence=over_time)

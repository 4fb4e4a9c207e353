"""A tool that was bumped, a tracker or an arm that was moved, a joint that slipped: a constant error up to one time.

What holds in the end is geometry; so the effect is what was different before.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import AXIS, ZERO, Effect
from modcal_core.effects.family import Family, ReportEntry, over_time
from modcal_core.effects.placements import OF_FRAME
from modcal_core.effects.registry import base_and_tool, breaks
from modcal_core.effects.shapes import Shape
from modcal_core.measurements import Samples, joints_instead
from modcal_core.measurements.kinds import kinds

NAME = "step"
_ENDS = 60  # times between stations, of which any two are tried as the ends of a shift, for time
_BY_POSITION = " by position:"


def candidates(drivers: Drivers) -> Iterator[Effect]:
    """Base, tool, every joint, and every zero of what reads one number, at every time between stations."""
    samples, single = drivers.samples, [name for name, kind in kinds().items() if kind.width == 1]
    lengths = np.unique(samples.frame[np.isin(samples.kind, single)]).tolist()
    places = [*base_and_tool(drivers), *((name, AXIS) for name in drivers.arm.chain.names)]
    places += [(OF_FRAME + samples.frames[f], ZERO) for f in lengths]
    for time in breaks(drivers):
        for place, direction in places:
            yield moved(place, direction, float(time))
    for since, at in combinations(breaks(drivers)[:: max(1, len(breaks(drivers)) // _ENDS)].tolist(), 2):
        for f in lengths:
            yield Effect(NAME, OF_FRAME + samples.frames[f], ZERO, "time", Shape("between", {"since": since, "at": at}))


def moved(place: str, direction: str, time: float) -> Effect:
    """A place that was elsewhere until a time [s]."""
    return Effect(NAME, place, direction, "time", Shape("until", {"at": time}))


def seen_within(place: str, direction: str, time: float) -> Effect:
    """A place that is elsewhere from a stamp of these samples on, which is no time of a calibration [s]."""
    return Effect(NAME, place, direction, "stamp", Shape("step", {"at": time}))


def same_as(effect: Effect, samples: Samples) -> tuple[str, ...]:
    """Joint errors that may explain a step, where the order of the stations correlates with joint positions."""
    return joints_instead(samples, effect.shape.settings["at"])


def sentence(entry: ReportEntry) -> str:
    """How far and when; and the joint that may err instead."""
    said = over_time(entry)
    if entry.direction == ZERO and (since := entry.sizes.get("since")):
        when = " to ".join(
            f"{'stamp' if unit == 's' else 'row'} {at:.0f}" for at, _, unit in (since, entry.sizes["at"])
        )
        return f"the zero of {entry.place.removeprefix(OF_FRAME)} was off by {entry.thousandths('zero')} from {when}"
    if entry.direction == ZERO:
        return f"the zero of {said.removeprefix(OF_FRAME)}"
    joints = [name.partition(_BY_POSITION)[2] for name in entry.same_as if _BY_POSITION in name]
    if not joints:
        return said
    return (
        f"either {said}, or {joints[0]} has an error that depends on its position: "
        "the stations before and after differ in it, so posture and time cannot be distinguished"
    )


FAMILY = Family(NAME, candidates, sentence=sentence, same_as=same_as)

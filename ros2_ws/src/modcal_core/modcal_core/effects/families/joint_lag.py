"""One joint whose reported position is late."""

from __future__ import annotations

from collections.abc import Iterator

from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.entry import ReportEntry
from modcal_core.effects.family import Family
from modcal_core.effects.observable import in_motion, moving_joints
from modcal_core.effects.shapes import Shape
from modcal_core.effects.sizes import Sizes, value
from modcal_core.robots.mechanism import Mechanism

NAME = "joint_lag"


def candidates(drivers: Drivers) -> Iterator[Effect]:
    """Every joint that moved, where readings were taken in motion."""
    for _, name in moving_joints(drivers) if in_motion(drivers) else ():
        yield Effect(NAME, name, AXIS, "velocity", Shape("linear"))


def sizes(effect: Effect, _: Mechanism) -> Sizes:
    """The delay: against that of readings, of which the amplitude is one."""
    return {"delay": value(effect, 0, -1.0, "s")}


def sentence(entry: ReportEntry) -> str:
    """The delay in milliseconds."""
    return f"{entry.place} reports its position {1e3 * entry.sizes['delay'][0]:.2f} ms late"


FAMILY = Family(NAME, candidates, sizes=sizes, sentence=sentence)

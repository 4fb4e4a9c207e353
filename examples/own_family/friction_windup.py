"""A drive that winds up against its friction, which grows with the load: the joint lags behind the way it came.

place: the joint. direction: about its axis. driver: the sign of its last motion times the size of its load. shape: a
straight line, its amplitude in rad per N m (m per N).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from modcal_core.effects import (
    AXIS,
    PLAIN,
    Drivers,
    Effect,
    Family,
    ReportEntry,
    Shape,
    Sizes,
    both_signs,
    unit_of,
    value,
)
from modcal_core.geometry import Array
from modcal_core.robots import Mechanism

NAME = "friction_windup"


def candidates(drivers: Drivers) -> Iterator[Effect]:
    """Every joint with a load that came from both sides."""
    for name in drivers.arm.chain.names if drivers.arm.weighed else ():
        if both_signs(drivers.values(f"direction:{name}")):
            yield Effect(NAME, name, AXIS, f"friction:{name}", Shape("linear"))


def friction(drivers: Drivers, joint: str) -> Array:
    """Against which the drive winds up, as a load (N,) [N m, N]: the way the joint came, times the size of its load."""
    return drivers.values(f"direction:{joint}") * np.abs(drivers.values(f"load:{joint}"))


def sizes(effect: Effect, chain: Mechanism) -> Sizes:
    """How far it winds up per load."""
    unit = unit_of(effect, chain)
    return {"windup": value(effect, 0, 1.0, f"{unit}/{'N m' if unit == 'rad' else 'N'}")}


def sentence(entry: ReportEntry) -> str:
    """What a technician should know of it."""
    size, _, unit = entry.sizes["windup"]
    return f"{entry.place}'s drive winds up against its friction by {size:.2e} {unit}: check its lubrication"


FAMILY = Family(
    NAME,
    candidates,
    drivers={"friction": friction},
    complexity=lambda effect: PLAIN,
    sizes=sizes,
    sentence=sentence,
)

"""An axis that tilts as it turns, once or twice a turn: a bearing that is not true."""

from __future__ import annotations

from collections.abc import Iterator

from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import ACROSS, Effect
from modcal_core.effects.family import Family, ReportEntry
from modcal_core.effects.registry import moving_joints
from modcal_core.effects.shapes import Shape

NAME = "axis_wobble"
_CYCLES = 2  # a turn, at most


def candidates(drivers: Drivers) -> Iterator[Effect]:
    """Every joint that turned."""
    for j, name in moving_joints(drivers):
        if drivers.arm.chain.revolute[j]:
            yield from whole(name, _CYCLES)


def whole(joint: str, most: int) -> Iterator[Effect]:
    """Wobbles of 1, 2, … ``most`` cycles a turn."""
    for cycles in range(1, most + 1):
        yield Effect(NAME, joint, ACROSS, f"position:{joint}", Shape("turn", {"cycles": float(cycles)}))


def sentence(entry: ReportEntry) -> str:
    """By how much it tilts."""
    return f"{entry.place}'s axis tilts by {entry.total} as it turns"


FAMILY = Family(NAME, candidates, sentence=sentence)

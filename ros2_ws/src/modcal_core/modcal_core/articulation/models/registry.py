"""All joint types: the built-in ones, and those that installed packages name by an entry point.

    [project.entry-points."modcal.articulation"]
    folding_door = "my_package.folding_door:MODEL"

names an instance of a class derived from :class:`~modcal_core.articulation.joint_motion.ArticulationModel`. From then
on ``choose`` and ``modcal articulate`` weigh it against the others.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any

from modcal_core.articulation.joint_motion import ArticulationModel, Kind
from modcal_core.articulation.models import prismatic, revolute, rigid, screw
from modcal_core.articulation.models.axis import AxisModel
from modcal_core.articulation.models.parametric import REMEDY, PathShape
from modcal_core.errors import BadRobot, BadTable
from modcal_core.measurements import added

GROUP = "modcal.articulation"
AXES: Mapping[Kind, AxisModel] = {m.name: m for m in (rigid.MODEL, prismatic.MODEL, revolute.MODEL, screw.MODEL)}
BUILT_IN: tuple[ArticulationModel, ...] = tuple(AXES.values())
STILL: ArticulationModel = next(m for m in BUILT_IN if not m.moves)
_MAX_SHARE = 0.5  # of all that moves, for all that packages add together


@cache
def all_models() -> tuple[ArticulationModel, ...]:
    """The built-in joint types, then those of packages. Raises BadTable for what is none, or takes another's name."""
    known = list(BUILT_IN)
    for offender, model in added(GROUP):
        if not isinstance(model, ArticulationModel):
            raise BadTable(offender, f"names a {type(model).__name__}", "name an instance of an ArticulationModel")
        if fault := _fault(model):
            raise BadTable(offender, fault, REMEDY)
        if model.name in {one.name for one in known}:
            raise BadTable(offender, f"kind {model.name} is already used", "choose another name")
        known.append(model)
    more = known[len(BUILT_IN) :]
    if (together := sum(model.share for model in more)) >= _MAX_SHARE:
        names = ", ".join(model.name for model in more)
        raise BadTable(f"articulation models {names}", f"their shares add up to {together:g}", "state smaller shares")
    return tuple(known)


def log_shares(models: Iterable[ArticulationModel]) -> dict[Kind, float]:
    """How often each type that moves is met, as a logarithm; the built-in ones share what packages leave."""
    moving = [model for model in models if model.moves]
    rest = math.log1p(-sum(model.share for model in moving if model not in BUILT_IN))
    return {model.name: math.log(model.share) + (rest if model in BUILT_IN else 0.0) for model in moving}


def axis_model(kind: Kind) -> AxisModel:
    """The joint type about one axis of this name. Raises BadRobot where there is none."""
    if kind not in AXES:
        raise BadRobot(f"joint {kind}", f"is not one of {', '.join(AXES)}", "name one of them")
    return AXES[kind]


def _fault(model: ArticulationModel) -> str:
    """What a model does not state as it must; empty where it does."""
    name: Any = getattr(model, "name", None)
    if not isinstance(name, str) or not name.isidentifier():
        return f"its name {name!r} is not a single word"
    try:
        share = float(model.share)
    except (AttributeError, TypeError, ValueError) as error:
        return f"does not state its share ({error})"
    if isinstance(model, PathShape) and (fault := model.fault()):
        return fault
    return "" if 0.0 < share < _MAX_SHARE else f"its share is {share:g}, not between 0 and {_MAX_SHARE:g}"

"""The kinds of reading there are: the built-in ones, and those that installed packages add.

A package adds a kind with an entry point of the group ``modcal.measurement_kinds`` that names an instance of
:class:`~modcal_core.measurements.kinds.kind.Kind`.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache

from modcal_core.errors import BadTable
from modcal_core.measurements.kinds.bearing import Bearing
from modcal_core.measurements.kinds.distance import DistanceKind
from modcal_core.measurements.kinds.kind import KIND_NAMES, MESSAGES, Kind
from modcal_core.measurements.kinds.positions import Point, Pose
from modcal_core.measurements.kinds.ray import Ray
from modcal_core.measurements.kinds.touch import Touch
from modcal_core.measurements.packages import added

GROUP = "modcal.measurement_kinds"
_LONGEST = KIND_NAMES.itemsize // 4  # letters
_OWN: tuple[Kind, ...] = (Pose(), Point(), DistanceKind(), Bearing(), Touch(), Ray())


@cache
def kinds() -> dict[str, Kind]:
    """Every kind by its name. Raises BadTable for one of a package that is no kind, or that takes another's name."""
    out = {kind.name: kind for kind in _OWN}
    for where, kind in added(GROUP):
        if not isinstance(kind, Kind):
            raise BadTable(where, f"names a {type(kind).__name__}", "name a Kind")
        if kind.name in out or kind.topic in {k.topic for k in out.values()}:
            raise BadTable(where, "its name or topic is already used", "choose others")
        if len(kind.name) > _LONGEST:
            raise BadTable(where, f"name of {len(kind.name)} letters", f"use at most {_LONGEST}")
        if kind.message not in MESSAGES:
            raise BadTable(where, f"message {kind.message}", f"use {', '.join(MESSAGES)}")
        out[kind.name] = kind
    return out


def is_direct(names: Iterable[str]) -> bool:
    """Whether all of these kinds are positions in a frame."""
    return all(kinds()[name].direct for name in names)

"""Words that name what is wrong: patterns, and what depends on the scene, on the joint i that was drawn most of all."""

from __future__ import annotations

from collections.abc import Callable
from operator import attrgetter

from case import Scene

QUATERNION = ("quaternion", r"\borientation", "rotation")
ORIENTATION = ("euler", "sequence", "convention", r"\borientation", "rotation")
UNIT = (r"\bmm\b", "millimet", r"\bunits?\b", "1000")
TOOL, BASE = (r"\btool\b",), (r"\bbase\b", r"\btracker\b")
EITHER = (*TOOL, *BASE)
LEFT_OUT = ("reject", "left out", "outlier", "plainly wrong", "shift", "apart")
LOAD = ("payload", r"\bload", "compliance", r"\bmass", r"\bkg\b")
COMPUTED = ("comput", "calculat")
FEW = ("station", "readings", "parameters")
BOLTED = ("geometry-only", "geometry only", "not looked for")
TRACKER = (r"\btracker\b", r"\binstrument\b", "place of the target", "distance from", "direction in which")
CLOCK = ("clock", "stamp", "delay", "late", r"\btime\b")
ROW = (r"\brows?\b", r"\border\b", "station before", "previous", "shift", "late", "delay", *CLOCK)
ORDER = (r"\border\b", r"\btime\b", "changed on the way", r"\bdrift\b", r"stations \d+ to")
READINGS = (
    r"\btracker",
    r"\bcamera",
    "reads wrong",
    r"readings? (?:look|depend)",
    "distance from",
    "place of the target",
)
STATIONS = r"stations? \d"


def JOINT(*numbers: int) -> Callable[[Scene], tuple[str, ...]]:
    """Joints by number."""
    return lambda c: tuple(c.names[k] for k in numbers)


def LINK(k: int) -> Callable[[Scene], str]:
    """The link behind a joint."""
    return lambda c: str(c.arm.links[k])


def around(low: int, high: int) -> Callable[[Scene], tuple[str, ...]]:
    """Joints from the one that was drawn, counted from it, those that there are."""
    return lambda c: tuple(c.names[max(c.i + low, 0) : c.i + high])


def OR_END(c: Scene) -> tuple[str, ...]:
    """The joint, the one before it, and at an end of the arm what is beyond."""
    return (*around(-1, 1)(c), *(BASE if c.i == 0 else ("tool",) if c.i == c.n - 1 else ()))


J, JJ, JJJ, NEAR = around(0, 1), around(0, 2), around(0, 3), around(-1, 2)
ALL, HAND, WRIST = attrgetter("names"), attrgetter("arm.hand"), JOINT(-3, -2, -1)


def FOOT(c: Scene) -> tuple[str, ...]:
    """The first joint, and the link that it stands on."""
    return (c.names[0], c.arm.parents[0])

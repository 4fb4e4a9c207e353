"""Words that name what is wrong: patterns, and what depends on the joint that was drawn (i)."""

from __future__ import annotations

from collections.abc import Callable

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


def J(c: Scene) -> str:
    """The joint."""
    return str(c.names[c.i])


def JJ(c: Scene) -> tuple[str, ...]:
    """The joint and the next one."""
    return tuple(c.names[c.i : c.i + 2])


def NEAR(c: Scene) -> tuple[str, ...]:
    """The joint, the one before it and the next one."""
    return tuple(c.names[max(c.i - 1, 0) : c.i + 2])


def ALL(c: Scene) -> tuple[str, ...]:
    """All joints."""
    return tuple(c.names)


def WRIST(c: Scene) -> tuple[str, ...]:
    """The last three joints."""
    return tuple(c.names[-3:])


def HAND(c: Scene) -> tuple[str, ...]:
    """The links behind the last joint."""
    return tuple(c.arm.hand)


def FOOT(c: Scene) -> tuple[str, ...]:
    """The first joint, and the link that it stands on."""
    return (c.names[0], c.arm.parents[0])


def OR_END(c: Scene) -> tuple[str, ...]:
    """The joint, the one before it, and at an end of the arm what is beyond."""
    beyond = BASE if c.i == 0 else ("tool",) if c.i == c.n - 1 else ()
    return (c.names[max(c.i - 1, 0)], c.names[c.i], *beyond)


def JOINT(*numbers: int) -> Callable[[Scene], tuple[str, ...]]:
    """Joints by number."""
    return lambda c: tuple(c.names[k] for k in numbers)


def LINK(k: int) -> Callable[[Scene], str]:
    """The link behind a joint."""
    return lambda c: str(c.arm.links[k])

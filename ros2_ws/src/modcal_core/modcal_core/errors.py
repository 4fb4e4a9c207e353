"""One base class for everything that modcal refuses, so that a caller can catch it and a person can act on it."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import nan
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")

# C0 and C1 controls but for line breaks and tabs, and what turns the direction of writing round
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def plain(text: str) -> str:
    """The text with control characters written out, so that a name from a file cannot steer a terminal."""
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


class ModcalError(Exception):
    """A refusal in one line: the offending input, the limit that it violates, and the remedy.

    Attributes hold the three parts; ``str(error)`` joins them into the line that the command prints on stderr.
    """

    def __init__(self, offender: str, limit: str, remedy: str) -> None:
        self.offender = plain(offender)
        self.limit = plain(limit)
        self.remedy = plain(remedy)
        super().__init__(" ".join(f"{self.offender}: {self.limit}: {self.remedy}".splitlines()))

    def __reduce__(self) -> tuple[type[ModcalError], tuple[str, str, str]]:
        """So that a refusal can travel between processes in its three parts."""
        return type(self), (self.offender, self.limit, self.remedy)


class BadRecording(ModcalError):
    """A recording that cannot be used: empty, without messages, in the wrong unit, or of another robot."""


class BadTable(ModcalError):
    """A table, mapping or calibration file with missing or invalid content."""


def refusing(read: Callable[P, T]) -> Callable[P, T]:
    """A reader of a file's data that refuses what it stumbles over: whatever no check before has named.

    The last argument that is a text is taken for the file's name.
    """

    @functools.wraps(read)
    def refuse(*arguments: P.args, **named: P.kwargs) -> T:
        try:
            return read(*arguments, **named)
        except (TypeError, ValueError, KeyError, AttributeError, IndexError, ArithmeticError, RecursionError) as error:
            names = [name for name in (*arguments, *named.values()) if isinstance(name, str)]
            said = f"holds a value that cannot be read ({type(error).__name__}: {str(error)[:80]})"
            raise BadTable(names[-1] if names else "file", said, "compare it with the documentation") from error

    return refuse


@contextmanager
def about(source: str) -> Iterator[None]:
    """Refusals from within name the file that they are about, where they do not do so already."""
    try:
        yield
    except ModcalError as error:
        if source in str(error):
            raise
        raise type(error)(f"{source}: {error.offender}", error.limit, error.remedy) from error


class BadRobot(ModcalError):
    """A robot description that cannot be used: a missing link, a tree that is not connected."""


class NotEnoughData(ModcalError):
    """Fewer stations than the parameters need."""


class NotRepresentable(ModcalError):
    """A result that the asked-for format cannot hold, such as nearly parallel axes in a DH table."""


class NotPlannable(ModcalError):
    """A requirement that no stations meet: nothing is visible, or the accuracy is finer than the repeatability."""


class NotReachable(ModcalError):
    """A pose that no posture within the limits reaches.

    ``position`` [m] and ``rotation`` [rad] say what was left, ``posture`` (n,) where; None where there was none.
    """

    def __init__(
        self, offender: str, limit: str, remedy: str, position: float = nan, rotation: float = nan, posture: Any = None
    ) -> None:
        self.position = position
        self.rotation = rotation
        self.posture = posture
        super().__init__(offender, limit, remedy)


class BadCommand(ModcalError):
    """A command that an arm must not follow: not a pose, in an unknown frame, too old, or too far in one step."""


class MissingDriver(ModcalError):
    """An input that a calibration depends on is missing: a temperature, an effort, a signal."""


class Overloaded(ModcalError):
    """A load or a motion that the drives cannot hold: too heavy a payload, a speed that takes all their torque."""

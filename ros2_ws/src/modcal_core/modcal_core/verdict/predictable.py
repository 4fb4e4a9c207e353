"""What a regressor that knows no physics predicts of what is left."""

from __future__ import annotations

from dataclasses import dataclass

from modcal_core.verdict.case import Case
from modcal_core.verdict.verdict import Share


@dataclass(frozen=True)
class Predictable:
    """Shares of the squared error that are predictable: both together (in variances), position, orientation.

    source: what predicts it best, for a person.
    """

    both: Share | None = None
    position: Share | None = None
    rotation: Share | None = None
    source: str = ""


def predictable(case: Case) -> Predictable:
    """The predictable shares of a case."""
    return Predictable()

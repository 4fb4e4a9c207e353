"""Numbers of things as people write them."""

from __future__ import annotations


def counted(count: int, thing: str) -> str:
    """A number and what it counts, in the plural where it is one: ``1 station``, ``2 stations``."""
    return f"{count} {thing}" if count == 1 else f"{count} {thing}s"


def percent(share: float, digits: int = 0) -> str:
    """A share in per cent, as the pages write it: with a space that does not break."""
    return f"{round(100.0 * share, digits) + 0.0:.{digits}f}\u00a0%"

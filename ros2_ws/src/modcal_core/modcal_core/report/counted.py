"""Numbers of things as people write them."""

from __future__ import annotations


def counted(count: int, thing: str) -> str:
    """A number and what it counts, in the plural where it is one: ``1 station``, ``2 stations``."""
    return f"{count} {thing}" if count == 1 else f"{count} {thing}s"

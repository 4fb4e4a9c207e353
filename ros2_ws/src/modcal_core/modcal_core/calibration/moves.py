"""Moves of base and tool during a recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

What = Literal["base", "tool", "both"]
WHATS: tuple[What, ...] = ("base", "tool", "both")


@dataclass(frozen=True)
class Move:
    """Base, tool or both moved at a time [s] between two stations."""

    at: float
    what: What

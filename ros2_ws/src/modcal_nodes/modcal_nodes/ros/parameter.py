"""One parameter of a node, as data; `modcal simulate` takes those of the cell, and needs no ROS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Parameter:
    """default: also gives the type. low, high: bounds of a number, both or neither.

    live: whether it may be changed while the node runs, and then takes effect; every other one is read-only.
    """

    default: Any
    description: str
    low: float | None = None
    high: float | None = None
    live: bool = False

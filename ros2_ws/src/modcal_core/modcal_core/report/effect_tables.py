"""Sizes of effects as tables, one for each unit: lengths in mm, angles in mrad, also where they are per something."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from modcal_core.report.page import PageTable

_FIRST = ("mrad", "mm")  # then the others by name, numbers without a unit last
_GROUPED = (1e4, 1e7)  # numbers between are written in full, their thousands apart
_STAMP = 1e8  # s; larger ones are moments, of which every second counts

Sizes = Mapping[str, Mapping[str, Any]]  # name of a quantity: value, std and unit, as in report.json


def scaled(unit: str) -> tuple[str, float]:
    """The unit that a person reads for one of SI, and what values are multiplied by."""
    for si, shown in (("rad", "mrad"), ("m", "mm")):
        if unit == si or unit.startswith(f"{si}/"):
            return shown + unit.removeprefix(si), 1e3
    return unit, 1.0


def number(value: float, digits: int = 4) -> str:
    """A number with a few digits; large ones in full."""
    if 1.0 <= abs(value) < _GROUPED[0]:
        rounded = float(f"{value:.{digits}g}")
        behind = max(digits - 1 - int(np.floor(np.log10(abs(rounded)))), 0)
        return f"{rounded:.{behind}f}".replace("-", "−")
    if _GROUPED[0] <= abs(value) < _GROUPED[1]:
        return f"{float(f'{value:.{digits}g}'):,.0f}".replace(",", "\u202f").replace("-", "−")
    return f"{value:.{digits}g}".replace("-", "−")


def with_deviation(quantity: Mapping[str, Any]) -> str:
    """Value and standard deviation in the unit that ``scaled`` gives, without it."""
    factor = scaled(quantity["unit"])[1]
    std = quantity["std"]
    if quantity["unit"] == "s" and abs(quantity["value"]) > _STAMP:
        return f"{quantity['value']:.1f}" + (f" ± {number(std, 1)}" if std else "")
    return number(factor * quantity["value"]) + (f" ± {number(factor * std, 1)}" if std else "")


def size_tables(rows: Iterable[tuple[str, Sizes]]) -> list[PageTable]:
    """A table for each unit of what effects are made of. rows: the name of an effect, and its sizes."""
    found: dict[str, list[tuple[str, ...]]] = {}
    for name, sizes in rows:
        for quantity, size in sizes.items():
            cells = (name, quantity.replace("_", " "), with_deviation(size))
            found.setdefault(scaled(str(size["unit"]))[0], []).append(cells)
    ranked = sorted(found, key=lambda unit: (_FIRST.index(unit) if unit in _FIRST else len(_FIRST), unit == "1", unit))
    return [
        PageTable(
            "Sizes without a unit" if unit == "1" else f"Sizes in {unit}",
            ("effect", "quantity", "value" if unit == "1" else f"value, {unit}"),
            tuple(found[unit]),
            words=2,
        )
        for unit in ranked
    ]

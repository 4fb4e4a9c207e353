"""Sizes of effects as tables, one for each unit: lengths in mm, angles in mrad, also where they are per something."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
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


def size_tables(rows: Iterable[tuple[tuple[str, ...], Sequence[Sizes | None]]], head: Sequence[str]) -> list[PageTable]:
    """A table for each unit of what effects are made of.

    rows: words that name an effect, and its sizes in one or more models; None where a model has it not. head: names of
    the words' columns, then of the models'.
    """
    found: dict[str, list[tuple[str, ...]]] = {}
    words = 0
    for names, models in rows:
        words = len(names)
        for quantity in dict.fromkeys(name for sizes in models if sizes for name in sizes):
            units = dict.fromkeys(str(sizes[quantity]["unit"]) for sizes in models if sizes and quantity in sizes)
            for unit in units:
                cells = (_cell(sizes, quantity, unit) for sizes in models)
                found.setdefault(scaled(unit)[0], []).append((*names, quantity.replace("_", " "), *cells))
    ranked = sorted(found, key=lambda unit: (_FIRST.index(unit) if unit in _FIRST else len(_FIRST), unit == "1", unit))
    return [
        PageTable(
            "Sizes without a unit" if unit == "1" else f"Sizes in {unit}",
            (*head[:words], "quantity", *(name + ("" if unit == "1" else f", {unit}") for name in head[words:])),
            tuple(found[unit]),
            words=words + 1,
        )
        for unit in ranked
    ]


def _cell(sizes: Sizes | None, quantity: str, unit: str) -> str:
    if sizes is None:
        return "not in it"
    return with_deviation(sizes[quantity]) if quantity in sizes and sizes[quantity]["unit"] == unit else ""

"""The parameters of a report as a technician reads them: one unit a table."""

from __future__ import annotations

from dataclasses import dataclass

Parameter = tuple[str, float, float, str]  # name, value, standard deviation, unit
_PARTS = (("m", "mm", 1e3, "Lengths"), ("rad", "mrad", 1e3, "Angles"), ("1", "‰", 1e3, "Ratios"))


@dataclass(frozen=True)
class ParameterTable:
    """Rows of one unit: name, value and standard deviation in it."""

    title: str
    unit: str
    rows: tuple[tuple[str, float, float], ...]


def parameter_tables(parameters: tuple[Parameter, ...]) -> tuple[ParameterTable, ...]:
    """All of them, a table for each unit."""
    parts = [(si, unit, factor, title) for si, unit, factor, title in _PARTS]
    known = {si for si, *_ in _PARTS}
    parts += [(unit, unit, 1.0, "Others") for unit in sorted({p[3] for p in parameters} - known)]
    tables = [
        ParameterTable(title, unit, tuple((name, factor * v, factor * s) for name, v, s, u in parameters if u == si))
        for si, unit, factor, title in parts
    ]
    return tuple(table for table in tables if table.rows)

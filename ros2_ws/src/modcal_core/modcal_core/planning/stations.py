"""Stations as plain data: joints by name, one list of positions a station."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.schema import require
from modcal_core.robots.table_rows import vector

_STATIONS = {"type": ["array", "null"], "items": {"type": "object"}}
_SCHEMA = {
    "type": "object",
    "properties": {
        "joints": {"type": "array", "items": {"type": "string"}},
        "stations": _STATIONS,
        "ties": {"type": ["array", "null"], "items": {"type": "object", "properties": {"stations": _STATIONS}}},
    },
}


def stations_from_data(data: Any, names: Sequence[str], source: str) -> Array:
    """Postures (N, n) [rad, m] of these joints in what a plan.yaml holds. Raises BadTable."""
    if not isinstance(data, Mapping) or data.get("modcal_plan") != 1:
        raise BadTable(source, "is not a plan: modcal_plan is not 1", "give the plan.yaml that modcal plan wrote")
    joints = data.get("joints")
    if not isinstance(joints, Sequence) or isinstance(joints, str):
        raise BadTable(source, "names no joints", "give the plan.yaml that modcal plan wrote")
    require(data, _SCHEMA, source, "give the plan.yaml that modcal plan wrote")
    rows = list(data.get("stations") or ())
    rows += [station for tie in data.get("ties") or () for station in tie.get("stations") or ()]
    values = [
        vector(row.get("position") if isinstance(row, Mapping) else None, len(joints), f"{source}, station {i + 1}")
        for i, row in enumerate(rows)
    ]
    return _of_joints(values, [str(j) for j in joints], names, source)


def stations_from_rows(rows: Sequence[Sequence[str]], names: Sequence[str], source: str) -> Array:
    """Postures (N, n) [rad, m] of these joints in a table whose first row names its columns. Raises BadTable."""
    head = [cell.strip() for cell in rows[0]] if rows else []
    full = [row for row in rows[1:] if any(cell.strip() for cell in row)]
    wanted = [k for k, name in enumerate(head) if name in names]
    values = [
        vector([row[k] if k < len(row) else "" for k in wanted], len(wanted), f"{source}, row {i + 2}")
        for i, row in enumerate(full)
    ]
    return _of_joints(values, [head[k] for k in wanted], names, source)


def _of_joints(values: Sequence[Array], joints: Sequence[str], names: Sequence[str], source: str) -> Array:
    for name in names:
        if joints.count(name) != 1:
            raise BadTable(f"{source}: joint {name}", "is not named once", f"name {', '.join(names)}")
    if not values:
        raise BadTable(source, "holds no station", "give one row a station")
    return np.stack(values)[:, [joints.index(name) for name in names]]

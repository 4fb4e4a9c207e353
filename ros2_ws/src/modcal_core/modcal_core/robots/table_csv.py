"""Kinematic tables as CSV, one row a joint; what is not of a joint stands in comment lines before them.

::

    # convention: dh
    # base_link: base_link
    # tip_link: tool0
    # base: 0.0 0.0 0.0 0.0 0.0 0.0            x y z [m], roll pitch yaw [rad]
    # tool: 0.0 0.0 0.0 0.0 0.0 0.0
    name,type,theta,d,a,alpha,lower,upper
    shoulder_pan_joint,revolute,0.0,0.1273,0.0,1.5707963267948966,-6.28,6.28

CPC has columns bx by bz lx ly lz beta reversed in place of the four. Numbers keep every digit. With a line
``# unit: mm deg`` lengths are in millimetres and angles in degrees throughout, as most controllers show them.
A table without names is of joints joint_1, joint_2, …; ``joint`` and ``offset`` are read as name and theta, as many
tables have them, and semicolons as commas. A turn or a length that no arm has is of another unit, and refused.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from typing import Any

from modcal_core.errors import BadTable

_VECTORS = {"b": ("bx", "by", "bz"), "l": ("lx", "ly", "lz")}
_DH = ("theta", "d", "a", "alpha")
_COLUMNS = {"dh": _DH, "mdh": _DH, "cpc": ("bx", "by", "bz", "lx", "ly", "lz", "beta", "reversed")}
_TEXTS = ("convention", "base_link", "tip_link")
_POSES = ("base", "tool")
_NOTE, _UNIT = "note", "unit"
# what a metre and a radian are in each unit
_DEGREES = 180.0 / math.pi
UNITS = {"m rad": (1.0, 1.0), "mm deg": (1e3, _DEGREES), "m deg": (1.0, _DEGREES), "mm rad": (1e3, 1.0)}
_ALSO_CALLED = {"joint": "name", "offset": "theta"}
_FULL_TURN = 6.3  # rad; a joint's offset or twist beyond is in degrees
_LONGEST_M = 10.0  # of a link; longer is in millimetres
_LENGTHS, _ANGLES = ("d", "a"), ("theta", "alpha", "beta")


def to_csv(table: Mapping[str, Any], notes: Sequence[str] = (), unit: str = "m rad") -> str:
    """The CSV text of a table as data (see :mod:`modcal_core.robots.table_rows`); notes become comments.

    unit: of :data:`UNITS`, in which the text is; the table is in m and rad.
    """
    out = io.StringIO()
    table = _scaled(table, *UNITS[unit])
    for key in _TEXTS:
        out.write(f"# {key}: {table[key]}\n")
    if unit != "m rad":
        out.write(f"# {_UNIT}: {unit}\n")
    for key in _POSES:
        out.write(f"# {key}: {' '.join(repr(v) for v in (*table[key]['xyz'], *table[key]['rpy']))}\n")
    for note in notes:
        out.write(f"# {_NOTE}: {note}\n")
    columns = ("name", "type", *_COLUMNS[table["convention"]], "lower", "upper")
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(columns)
    for joint in table["joints"]:
        cells = dict(joint)
        for key, names in _VECTORS.items():
            cells.update(zip(names, cells.pop(key, ()), strict=False))
        rows.writerow([_cell(cells.get(column)) for column in columns])
    return out.getvalue()


def from_csv(text: str, source: str = "table") -> dict[str, Any]:
    """The table as data, in m and rad, that a CSV text holds. Raises BadTable with the line."""
    table: dict[str, Any] = {}
    unit = "m rad"
    lines = text.lstrip("\ufeff").splitlines()
    while lines and (lines[0].startswith("#") or not lines[0].strip()):
        key, _, value = lines.pop(0).lstrip("# ").partition(":")
        key, value = key.strip(), value.strip()
        if key in _TEXTS:
            table[key] = value
        elif key in _POSES:
            numbers = _numbers(value, 6, f"{source}, {key}")
            table[key] = {"xyz": numbers[:3], "rpy": numbers[3:]}
        elif key == _UNIT:
            if value not in UNITS:
                raise BadTable(f"{source}, unit", f"is '{value}'", f"write one of {', '.join(UNITS)}")
            unit = value
        elif key and key != _NOTE:
            known = ", ".join((*_TEXTS, *_POSES, _UNIT, _NOTE))
            raise BadTable(f"{source}, comment '{key}'", "is not a key of the table", f"write one of {known}")
    convention = table.get("convention")
    if convention not in _COLUMNS:
        said = "states no convention" if convention is None else f"convention '{convention}' is unknown"
        raise BadTable(source, said, f"begin with a line such as '# convention: dh' ({', '.join(_COLUMNS)})")
    rows = csv.reader(lines, delimiter=";" if lines and ";" in lines[0] and "," not in lines[0] else ",")
    header = [_ALSO_CALLED.get(cell.strip(), cell.strip()) for cell in next(rows, [])]
    allowed = {"name", "type", *_COLUMNS[convention], "lower", "upper"}
    if not header or not set(header) <= allowed or len(set(header)) < len(header):
        odd = next((c for c in header if c not in allowed), next((c for c in header if header.count(c) > 1), ""))
        said = f"column '{odd}' is not one of a {convention} table" if odd not in allowed else f"has '{odd}' twice"
        said = said if header else "has no columns"
        raise BadTable(source, said, f"write {','.join(('name', 'type', *_COLUMNS[convention], 'lower', 'upper'))}")
    table["joints"] = [_joint(row, header, f"{source}, joint {i + 1}") for i, row in enumerate(rows) if any(row)]
    for i, joint in enumerate(table["joints"]):
        if joint.get("name", "").isdigit():
            joint["name"] = f"joint_{joint['name']}"
        _require_unit(joint, unit, f"{source}, joint {i + 1}")
    return _scaled(table, *(1.0 / factor for factor in UNITS[unit]))


def _require_unit(joint: Mapping[str, Any], unit: str, where: str) -> None:
    """Raises BadTable for a turn or a length that no arm has, in this unit."""
    metre, radian = UNITS[unit]
    for keys, most, size in ((_ANGLES, _FULL_TURN, radian), (_LENGTHS, _LONGEST_M, metre)):
        for key in keys:
            if abs(joint.get(key, 0.0)) > most * size:
                said = f"is {joint[key]:g}, in the unit {unit}"
                raise BadTable(f"{where}: {key}", said, f"write the unit as '# unit: mm deg' ({', '.join(UNITS)})")


def _scaled(table: Mapping[str, Any], length: float, angle: float) -> dict[str, Any]:
    """The table with every length and every angle times a factor."""
    out = dict(table)
    for key in _POSES:
        if key in out:
            pose = out[key]
            out[key] = {"xyz": [length * v for v in pose["xyz"]], "rpy": [angle * v for v in pose["rpy"]]}
    out["joints"] = [_scaled_row(row, length, angle) for row in table["joints"]]
    return out


def _scaled_row(row: Mapping[str, Any], length: float, angle: float) -> dict[str, Any]:
    out = dict(row)
    limit = length if row.get("type") == "prismatic" else angle
    factors = dict.fromkeys(_LENGTHS, length) | dict.fromkeys(_ANGLES, angle) | {"lower": limit, "upper": limit}
    out.update({key: factor * out[key] for key, factor in factors.items() if key in out})
    if "l" in out:
        out["l"] = [length * v for v in out["l"]]
    return out


def _joint(row: list[str], header: list[str], where: str) -> dict[str, Any]:
    if len(row) != len(header):
        raise BadTable(where, f"has {len(row)} cells, the header {len(header)}", "correct the line")
    cells = {key: cell.strip() for key, cell in zip(header, row, strict=True) if cell.strip()}
    out: dict[str, Any] = {key: cells.pop(key) for key in ("name", "type") if key in cells}
    if "reversed" in cells:
        said = cells.pop("reversed").lower()
        if said not in ("true", "false"):
            raise BadTable(f"{where}: reversed", f"is '{said}'", "write true or false")
        out["reversed"] = said == "true"
    for key, names in _VECTORS.items():
        if any(name in cells for name in names):
            out[key] = _numbers(" ".join(cells.pop(name, "?") for name in names), 3, f"{where}: {key}")
    out.update({key: _numbers(cell, 1, f"{where}: {key}")[0] for key, cell in cells.items()})
    return out


def _numbers(text: str, count: int, where: str) -> list[float]:
    try:
        out = [float(word) for word in text.split()]
    except ValueError:
        out = []
    if len(out) != count:
        raise BadTable(where, f"needs {count} number{'s' * (count > 1)}, has '{text}'", "correct the table")
    return out


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(float(value)) if isinstance(value, int | float) else str(value)

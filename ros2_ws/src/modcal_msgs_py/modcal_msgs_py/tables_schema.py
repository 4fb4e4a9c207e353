"""The mapping of ``modcal import``, as a schema: what it may say, key by key."""

from __future__ import annotations

import codecs
from collections.abc import Mapping
from typing import Any

from modcal_core.errors import BadTable
from modcal_core.measurements.schema import Schema, require, shown

_REMEDY = "see docs/recordings.md"
_COLUMN = {"type": ["string", "integer"]}
_COLUMNS = {"type": "array", "items": _COLUMN, "minItems": 3, "maxItems": 3}
_FRAME = {"type": "string", "minLength": 1}
_LENGTH = {"type": "string", "enum": ["m", "mm"]}
_PERIOD = {"type": "number", "exclusiveMinimum": 0, "maximum": 1e6}
_ANGLE = {"type": "string", "enum": ["rad", "deg"]}


def _mapping(properties: Schema, *required: str) -> Schema:
    return {"type": "object", "properties": properties, "required": list(required), "additionalProperties": False}


_TIME = {
    "type": "object",
    "oneOf": [
        _mapping({"column": _COLUMN, "format": {"type": "string", "minLength": 1}}, "format"),
        _mapping({"seconds": _COLUMN}, "seconds"),
        _mapping({"order": _mapping({"period_s": _PERIOD}, "period_s")}, "order"),
    ],
}  # fmt: skip
_EULER = _mapping(
    {"columns": _COLUMNS, "unit": _ANGLE, "sequence": {"type": "string", "minLength": 3, "maxLength": 3}},
    "columns", "unit", "sequence",
)  # fmt: skip
_QUATERNION = _mapping({"columns": {**_COLUMNS, "minItems": 4, "maxItems": 4}}, "columns")
_POSE = _mapping(
    {
        "frame": _FRAME, "unit": _LENGTH, "position": _COLUMNS, "inverse": {"type": "boolean"}, "euler": _EULER,
        "quaternion": _QUATERNION, "rotvec": _mapping({"columns": _COLUMNS, "unit": _ANGLE}, "columns", "unit"),
    },
    "frame", "unit", "position",
)  # fmt: skip
_TABLE = _mapping(
    {
        "files": {"type": "string", "minLength": 1},
        "delimiter": {"type": "string", "minLength": 1, "maxLength": 1},
        "decimal": {"type": "string", "enum": [".", ","]},
        "header": {"type": "boolean"},
        "encoding": {"type": "string"},
        "time": _TIME,
        "joints": _mapping(
            {"unit": _ANGLE, "columns": {"type": "object", "additionalProperties": _COLUMN, "minProperties": 1}},
            "unit", "columns",
        ),
        "pose": _POSE,
        "point": _mapping({"frame": _FRAME, "unit": _LENGTH, "position": _COLUMNS}, "frame", "unit", "position"),
        "same_point": _mapping({"frame": _FRAME}, "frame"),
        "temperature": {"type": ["object", "null"], "additionalProperties": _COLUMN},
    },
    "files", "time", "joints",
)  # fmt: skip
SCHEMA = _mapping(
    {"urdf": {"type": ["string", "null"]}, "tables": {"type": "array", "items": _TABLE, "minItems": 1}}, "tables"
)


def require_mapping(mapping: Any, source: str) -> Mapping[str, Any]:
    """The mapping, if it is one. Raises BadTable with the key that is not as it must be."""
    require(mapping, SCHEMA, source, _REMEDY)
    for i, table in enumerate(mapping["tables"]):
        where = f"{source}: tables, entry {i + 1}"
        delimiter, decimal = table.get("delimiter", ","), table.get("decimal", ".")
        if delimiter in '\r\n"\0':
            raise BadTable(f"{where}: delimiter", f"{shown(delimiter)} cannot separate columns", _REMEDY)
        if delimiter == decimal:
            raise BadTable(f"{where}: decimal", f"{shown(decimal)} is the delimiter too", "state the other one")
        if not _is_text_encoding(table.get("encoding", "utf-8-sig")):
            raise BadTable(f"{where}: encoding", f"{shown(table['encoding'])} is not a text encoding", "e.g. utf-8")
        kinds = [k for k in ("pose", "point", "same_point") if k in table]
        if len(kinds) != 1:
            said = f"{len(kinds)} of pose, point and same_point are stated"
            raise BadTable(where, said, "state one of them")
        pose = table.get("pose", {})
        if kinds == ["pose"] and sum(k in pose for k in ("euler", "quaternion", "rotvec")) != 1:
            said = "its angle convention is not stated"
            raise BadTable(f"{where}: pose", said, "state euler, quaternion or rotvec")
    return mapping


def _is_text_encoding(name: str) -> bool:
    try:
        "".encode(name)
        return codecs.lookup(name) is not None
    except (LookupError, ValueError, UnicodeError):
        return False

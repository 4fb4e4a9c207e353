"""What of a report.json is read again, as a schema: key by key, whatever else is in it."""

from __future__ import annotations

from modcal_core.measurements import Schema

_NUMBER = {"type": "number"}
_NULL_NUMBER = {"type": ["number", "null"]}
_TEXT = {"type": "string"}
_NULL_TEXT = {"type": ["string", "null"]}


def _mapping(properties: Schema, *required: str) -> Schema:
    return {"type": "object", "properties": properties, "required": list(required)}


def _or_null(schema: Schema) -> Schema:
    return {**schema, "type": [schema["type"], "null"]}


_PAIR = {"type": ["array", "null"], "items": _NUMBER, "minItems": 2, "maxItems": 2}
_SIZE = _or_null(
    _mapping({**{k: _NUMBER for k in ("mean", "rms", "p95", "max")}, "rms_ci95": _PAIR}, "mean", "rms", "p95", "max")
)
_QUANTITY = _mapping({"value": _NUMBER, "std": _NULL_NUMBER, "unit": _TEXT}, "value", "std", "unit")
_EFFECT = _mapping(
    {
        **{name: _TEXT for name in ("family", "place", "direction", "driver")},
        "parameters": {"type": "object", "additionalProperties": _QUANTITY},
    },
    *("family", "place", "direction", "driver", "parameters"),
)
_PARAMETER = _mapping({"name": _TEXT, "value": _NUMBER, "std": _NUMBER, "unit": _TEXT}, "name", "value", "std", "unit")
SCHEMA = _mapping(
    {
        "modcal_report": {"type": "integer", "enum": [1]},
        "recording": _mapping({"stations": {"type": "integer"}, "joints": {"type": "array", "items": _TEXT}}),
        "error_mm": _mapping({"final": _SIZE}),
        "effects": {"type": "array", "items": _EFFECT},
        "unproved": {"type": "array", "items": _EFFECT},
        "parameters": {"type": "array", "items": _PARAMETER},
        "status": _TEXT,
        "open_because": {"type": "array", "items": _TEXT},
        "trace": _or_null(_mapping({name: _NULL_TEXT for name in ("date", "version", "robot")})),
        "tolerance": _or_null(_mapping({"result": _TEXT})),
    },
    "modcal_report",
)

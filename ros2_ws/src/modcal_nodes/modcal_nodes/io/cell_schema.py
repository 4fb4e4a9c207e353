"""The cell file, as a schema: what it may say, key by key."""

from __future__ import annotations

from dataclasses import fields

from modcal_core.calibration.moves import WHATS
from modcal_core.measurements.schema import Schema
from modcal_core.report.particulars import Particulars

_NUMBER = {"type": "number"}
_TEXT = {"type": "string", "minLength": 1}
_TEXTS = {"type": ["array", "null"], "items": {"type": "string"}}
_WHAT = {"type": "string", "enum": list(WHATS)}
_THREE = {"type": "array", "items": _NUMBER, "minItems": 3, "maxItems": 3}


def _mapping(properties: Schema, *required: str) -> Schema:
    return {"type": "object", "properties": properties, "required": list(required), "additionalProperties": False}


def _list(items: Schema) -> Schema:
    return {"type": ["array", "null"], "items": items}


_PAIR = {"type": "array", "items": {"type": "string"}, "minItems": 2, "maxItems": 2}
_STAMPS = {"type": "array", "items": _NUMBER, "minItems": 2, "maxItems": 2}
_DISTANCE = {"distance_m": _NUMBER, "std_m": _NUMBER}
_PLANE = _mapping({"normal": _THREE, "offset_m": _NUMBER}, "normal", "offset_m")
_QUATERNION = {"type": "array", "items": _NUMBER, "minItems": 4, "maxItems": 4}
_POSE = {"position_m": _THREE, "quaternion": _QUATERNION}
SCHEMA = _mapping(
    {
        "distances": _list(
            {
                "type": "object",
                "oneOf": [
                    _mapping({"between": _PAIR, **_DISTANCE}, "between", "distance_m"),
                    _mapping({"stamps": _STAMPS, **_DISTANCE}, "stamps", "distance_m"),
                ],
            }
        ),
        "fixed": _TEXTS,
        "own_target": _TEXTS,
        "sockets": _TEXTS,
        "known": _list(
            _mapping(
                {"frame": _TEXT, "in": _TEXT, "plane": _PLANE, **_POSE, "std_m": _NUMBER, "std_deg": _NUMBER},
                "frame",
                "in",
            )
        ),
        "tool": {
            **_mapping({**_POSE, "std_m": _NUMBER, "std_deg": _NUMBER}, "position_m", "std_m"),
            "type": ["object", "null"],
        },
        "payloads": _list(_mapping({"mass_kg": _NUMBER, "centre_m": _THREE}, "mass_kg")),
        "gravity": {**_THREE, "type": ["array", "null"]},
        "moved": _list(_mapping({"stamp": _NUMBER, "what": _WHAT}, "stamp", "what")),
        "own_in_recordings": {**_WHAT, "type": ["string"]},
        "repeatability_mm": _NUMBER,
        "repeatability_deg": _NUMBER,
        "repeatability_iso": _NUMBER,
        "instrument_mm": _NUMBER,
        "instrument_deg": _NUMBER,
        "topics": {"type": ["object", "null"], "additionalProperties": {"type": ["string", "array"], "items": _TEXT}},
        "ignore": _TEXTS,
        "tf": {"type": ["string", "null"]},
        "certificate": {**_mapping({field.name: _TEXT for field in fields(Particulars)}), "type": ["object", "null"]},
    }
)

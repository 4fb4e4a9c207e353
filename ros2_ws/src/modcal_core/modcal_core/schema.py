"""Whole files against a schema: which keys there are, of which type and within which bounds.

Schemas are written as JSON Schema (draft 2020-12) writes them; of its words only those below are known, and any other
is a mistake of the schema's author. The first complaint is raised, with the place in the file.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Mapping, Sequence
from typing import Any

from modcal_core.errors import BadTable

Schema = Mapping[str, Any]
_WORDS = {
    "type", "enum", "properties", "required", "additionalProperties", "minProperties", "items", "minItems", "maxItems",
    "minimum", "maximum", "exclusiveMinimum", "minLength", "maxLength", "oneOf", "description",
}  # fmt: skip
_NAMES = {
    "object": "a mapping", "array": "a list", "string": "a text", "number": "a finite number",
    "integer": "a whole number", "boolean": "true or false", "null": "nothing",
}  # fmt: skip


NUMBER: Schema = {"type": "number"}
SIZE: Schema = {"type": "number", "minimum": 0}
POSITIVE: Schema = {"type": "number", "exclusiveMinimum": 0}
TEXT: Schema = {"type": "string"}


def record(required: Sequence[str] = (), /, **properties: Schema) -> Schema:
    """A mapping with these keys and no others."""
    return {**holding(required, **properties), "additionalProperties": False}


def holding(required: Sequence[str] = (), /, **properties: Schema) -> Schema:
    """A mapping with these keys, and whatever others."""
    return {"type": "object", "required": required, "properties": properties}


def mapping_of(values: Schema) -> Schema:
    """A mapping whose values are all like this."""
    return {"type": "object", "additionalProperties": values}


def list_of(items: Schema, least: int = 0, most: int | None = None) -> Schema:
    """A list of so many entries like this."""
    return {"type": "array", "items": items, "minItems": least, **({} if most is None else {"maxItems": most})}


def whole(least: int, most: int) -> Schema:
    """A whole number between these, both included."""
    return {"type": "integer", "minimum": least, "maximum": most}


def stated(data: Any) -> Any:
    """The data without keys that have no value."""
    if not isinstance(data, Mapping):
        return data
    return {key: stated(value) for key, value in data.items() if value is not None}


def require(data: Any, schema: Schema, source: str, remedy: str) -> None:
    """Raises BadTable, naming the source and the place in it, unless the data is what the schema describes."""
    assert set(schema) <= _WORDS, set(schema) - _WORDS
    if "type" in schema:
        kinds = [schema["type"]] if isinstance(schema["type"], str) else schema["type"]
        if not any(_is(data, kind) for kind in kinds):
            raise BadTable(source, f"{shown(data)} is not {' or '.join(_NAMES[kind] for kind in kinds)}", remedy)
    if "enum" in schema and not any(type(data) is type(one) and data == one for one in schema["enum"]):
        raise BadTable(source, f"{shown(data)} is not one of {', '.join(map(str, schema['enum']))}", remedy)
    if isinstance(data, str):
        _check_size(len(data), schema, source, remedy, ("minLength", "maxLength"), "letters", shown(data))
    elif isinstance(data, Mapping):
        _check_mapping(data, schema, source, remedy)
    elif isinstance(data, Sequence):
        _check_size(len(data), schema, source, remedy, ("minItems", "maxItems"), "entries", "it")
        if "items" in schema:
            for i, item in enumerate(data):
                require(item, schema["items"], f"{source}, entry {i + 1}", remedy)
    elif isinstance(data, int | float) and not isinstance(data, bool):
        _check_number(data, schema, source, remedy)
    if "oneOf" in schema:
        _check_one_of(data, schema["oneOf"], source, remedy)


def shown(value: Any) -> str:
    """A value in few letters, however large it is."""
    return reprlib.repr(value)[:80]


def told(error: Exception) -> str:
    """What an exception says, in few letters, and of which kind it is."""
    return f"{type(error).__name__}: {error}"[:200]


def _is(data: Any, kind: str) -> bool:
    if kind == "object":
        return isinstance(data, Mapping)
    if kind == "array":
        return isinstance(data, Sequence) and not isinstance(data, str | bytes)
    if kind == "string":
        return isinstance(data, str) and _is_text(data)
    if kind == "boolean":
        return isinstance(data, bool)
    if kind == "null":
        return data is None
    if isinstance(data, bool) or not isinstance(data, int | float):
        return False
    if kind == "integer":
        return isinstance(data, int)
    try:
        return math.isfinite(data)
    except OverflowError:  # of an integer with hundreds of digits
        return False


def _is_text(data: str) -> bool:
    """Whether a text can be written to a file: half of a surrogate pair, which YAML lets one escape, cannot."""
    try:
        data.encode()
    except UnicodeEncodeError:
        return False
    return True


def _check_size(
    size: int, schema: Schema, where: str, remedy: str, words: tuple[str, str], what: str, said: str
) -> None:
    low, high = schema.get(words[0], 0), schema.get(words[1], math.inf)
    if not low <= size <= high:
        allowed = f"{low}" if low == high else f"at least {low}" if size < low else f"at most {high}"
        raise BadTable(where, f"{said} has {size} {what}, {allowed} are allowed", remedy)


def _check_number(data: float, schema: Schema, where: str, remedy: str) -> None:
    if data < schema.get("minimum", -math.inf) or data > schema.get("maximum", math.inf):
        low, high = (schema.get(word) for word in ("minimum", "maximum"))
        bound = f"at least {low}" if high is None else f"at most {high}"
        allowed = f"{low} to {high}" if None not in (low, high) else bound
        raise BadTable(where, f"{shown(data)} is out of range, {allowed} is allowed", remedy)
    if "exclusiveMinimum" in schema and data <= schema["exclusiveMinimum"]:
        raise BadTable(where, f"{shown(data)} is not above {schema['exclusiveMinimum']}", remedy)


def _check_mapping(data: Mapping[Any, Any], schema: Schema, where: str, remedy: str) -> None:
    known: Mapping[str, Schema] = schema.get("properties", {})
    for key in schema.get("required", ()):
        if key not in data:
            raise BadTable(where, f"'{key}' is not stated", remedy)
    if len(data) < schema.get("minProperties", 0):
        raise BadTable(where, "is empty", remedy)
    others = schema.get("additionalProperties", True)
    for key, value in data.items():
        if not isinstance(key, str) or not _is_text(key):
            raise BadTable(where, f"key {shown(key)} is not a text", remedy)
        if key in known:
            require(value, known[key], f"{where}: {key}", remedy)
        elif others is False:
            raise BadTable(where, f"unknown key {key[:80]}; known are {', '.join(sorted(known))}", remedy)
        elif others is not True:
            require(value, others, f"{where}: {key}", remedy)


def _check_one_of(data: Any, choices: Sequence[Schema], where: str, remedy: str) -> None:
    """Of mappings the choice is the one whose required keys are there; its complaints are the mapping's."""
    if not isinstance(data, Mapping):
        return
    choices = [choice for choice in choices if choice["type"] == "object"]
    fitting = [choice for choice in choices if all(key in data for key in choice.get("required", ()))]
    if len(fitting) != 1:
        ways = " or ".join(" and ".join(choice.get("required", ())) for choice in choices)
        raise BadTable(where, f"{len(fitting)} of these ways are stated: {ways}", remedy)
    require(data, fitting[0], where, remedy)

"""Messages of any type as plain data, and filled from plain data, as a person reads and writes them in YAML."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from importlib import import_module
from typing import Any

from modcal_core.errors import BadTable

_MANY = re.compile(r"sequence<([^,>]+)|([^\[]+)\[(\d+)\]$")
_INTEGER = re.compile(r"(u?)int(8|16|32|64)$")


def message_data(message: Any) -> Any:
    """A message as mappings, lists, texts and numbers; None for a number that is not finite."""
    if hasattr(message, "get_fields_and_field_types"):
        return {name: message_data(getattr(message, name)) for name in message.get_fields_and_field_types()}
    if isinstance(message, float):
        return float(message) if math.isfinite(message) else None
    if isinstance(message, str | int):
        return message
    return [message_data(one) for one in (message.tolist() if hasattr(message, "tolist") else message)]


def fill_message(message: Any, data: Any, where: str) -> Any:
    """The message with the fields that a mapping names. where: what the data are, for refusals.

    Raises BadTable for a field that the message does not have, and a value that a field cannot hold.
    """
    kinds = message.get_fields_and_field_types()
    names = ", ".join(f"{name}: {kind}" for name, kind in kinds.items())
    if not isinstance(data, Mapping) or not set(data) <= set(kinds):
        raise BadTable(where, f"{data!r} are not its fields", f"give some of {{{names}}}")
    for name, value in data.items():
        setattr(message, name, _value(kinds[name], value, f"{where}.{name}"))
    return message


def _value(kind: str, value: Any, where: str) -> Any:
    """The value as a field of this kind takes it; a whole number for one with a point would be sent as another."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if many := _MANY.match(kind):
        if isinstance(value, list) and len(value) == int(many[3] or len(value)):
            return [_value(many[1] or many[2], one, f"{where}[{i}]") for i, one in enumerate(value)]
    elif "/" in kind:
        package, _, name = kind.partition("/")
        return fill_message(getattr(import_module(f"{package}.msg"), name)(), value, where)
    elif integer := _INTEGER.match(kind):
        signed = 0 if integer[1] else 2 ** (int(integer[2]) - 1)
        if number and isinstance(value, int) and -signed <= value < 2 ** int(integer[2]) - signed:
            return value
    elif kind == "octet":
        if number and value in range(256):
            return bytes([int(value)])
    elif kind in ("double", "float"):
        if number:
            return float(value)
    elif isinstance(value, bool if kind == "boolean" else str):
        return value
    raise BadTable(where, f"{value!r} is no {kind}", "write one, in YAML")

"""Messages as publishers sent them, and messages of any type as plain data that a person reads and writes in YAML."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from heapq import heappop, heappush
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from modcal_core.errors import BadTable
from modcal_msgs_py.bag_files import bag_files, named_qos
from modcal_msgs_py.bag_open import PackedMessage, bag_file, packed_messages, topics_of, unpacked
from modcal_msgs_py.topics import LATCHED, TF_STATIC

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


_WINDOW = 500_000_000  # ns; a recorder takes topic by topic, so a file is nearly in the order of reception


class OfferedTopic(NamedTuple):
    """A topic of a bag, and the QoS that satisfies all who heard its publishers. depth: 0 where it is not stated."""

    type_name: str
    reliable: bool
    latched: bool
    depth: int


def offered_topics(path: Path) -> dict[str, OfferedTopic]:
    """The topics of a bag that have messages, as they were offered; by the contract where nothing is stated."""
    out = {}
    with unpacked(bag_files(path)[0]) as files:
        for file in map(bag_file, files):
            for (name, type_name), count in topics_of(file).items():
                if count:
                    out[name] = _offered(name, type_name, file.offered.get(name, ""))
    return out


def _offered(name: str, type_name: str, stated: str) -> OfferedTopic:
    """What satisfies reliable and late listeners satisfies the others too."""
    if not (profiles := named_qos(stated)):
        return OfferedTopic(type_name, True, name == TF_STATIC or name.endswith(tuple(f"/{r}" for r in LATCHED)), 0)
    reliable = any(profile.get("reliability") != "best_effort" for profile in profiles)
    latched = any(profile.get("durability") == "transient_local" for profile in profiles)
    depths = [depth for profile in profiles if isinstance(depth := profile.get("depth"), int)]
    return OfferedTopic(type_name, reliable, latched, max(depths, default=0))


def messages_in_order(
    path: Path, topics: Collection[str], heard: Callable[[float], None], said: Callable[[str], None]
) -> Iterator[PackedMessage]:
    """The messages of these topics in the order of reception. heard, said: as of packed_messages."""
    waiting: list[tuple[int, int, PackedMessage]] = []
    for number, message in enumerate(packed_messages(path, topics, heard, said)):
        heappush(waiting, (message.received_ns, number, message))
        while waiting[0][0] <= message.received_ns - _WINDOW:
            yield heappop(waiting)[2]
    while waiting:
        yield heappop(waiting)[2]

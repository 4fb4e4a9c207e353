"""ROS 2 Jazzy message types without ROS: definitions, serialisation, type hashes."""

from __future__ import annotations

import contextlib
from functools import cache, lru_cache
from typing import Any

from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

_LONGEST_TEXT = 1 << 18  # of a definition; real ones have some kilobytes
_LINE = "=" * 80 + "\n"  # between the definitions of a text


@cache
def jazzy() -> Typestore:
    """The message types of ROS 2 Jazzy, shared by all callers."""
    return get_typestore(Stores.ROS2_JAZZY)


def message_class(type_name: str) -> Any:
    """The class of a message type, such as ``sensor_msgs/msg/JointState``."""
    return jazzy().types[type_name]


def definition(type_name: str) -> tuple[str, str]:
    """(full definition text, RIHS01 type hash) of a message type."""
    text, _ = jazzy().generate_msgdef(type_name, ros_version=2)
    return text, jazzy().hash_rihs01(type_name)


def serialise(message: Any, type_name: str) -> bytes:
    """CDR bytes of a message."""
    return bytes(jazzy().serialize_cdr(message, type_name))


@lru_cache(maxsize=256)
def definitions(type_name: str, text: str) -> dict[str, Any]:
    """What a definition text, as MSG or IDL, says of a type and of those it uses; nothing where it cannot be read.

    A text comes from a file and may say anything. The reader of definitions is not made for that: it raises whatever
    the text leads it to, and goes as deep as the text does.
    """
    if len(text) > _LONGEST_TEXT:
        return {}
    try:
        if "\nIDL: " not in f"\n{text}":
            return dict(get_types_from_msg(text, type_name))
        found: dict[str, Any] = {}
        for part in text.split(_LINE):
            head, _, body = part.partition("\n")
            found.update(get_types_from_idl(body) if head.startswith("IDL: ") else {})
        return found
    except Exception:
        return {}


def store_with(type_name: str, text: str) -> Typestore:
    """The Jazzy types, and besides them those that the definition of this type adds, as far as they can be had."""
    if type_name in jazzy().types or not text:
        return jazzy()
    return _store_with(type_name, text)


@lru_cache(maxsize=16)
def _store_with(type_name: str, text: str) -> Typestore:
    store = get_typestore(Stores.ROS2_JAZZY)
    with contextlib.suppress(Exception):  # as above
        store.register({k: v for k, v in definitions(type_name, text).items() if k not in store.types})
    return store

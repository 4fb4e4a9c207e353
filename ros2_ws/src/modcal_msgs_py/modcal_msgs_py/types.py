"""ROS 2 Jazzy message types without ROS: definitions, serialisation, type hashes."""

from __future__ import annotations

from functools import cache
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore


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


def store_with(schemas: dict[str, str]) -> Typestore:
    """The Jazzy types, and besides them the types that these definitions (name → text) add."""
    missing = {name: text for name, text in schemas.items() if name not in jazzy().types}
    if not missing:
        return jazzy()
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in missing.items():
        types = get_types_from_msg(text, name)
        store.register({k: v for k, v in types.items() if k not in store.types})
    return store

"""The fields of message types, as ``layout`` reads them.

Those of the contract's topics are written down here; others come out of the definitions that bags bring along.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

from modcal_msgs_py.layout import Fields, Kind, Many

_HEADER: Fields = [("stamp", [("sec", "i4"), ("nanosec", "u4")]), ("frame_id", "string")]
_XYZ: Fields = [("x", "f8"), ("y", "f8"), ("z", "f8")]
_XYZW: Fields = [*_XYZ, ("w", "f8")]
KNOWN: dict[str, Fields] = {
    "sensor_msgs/msg/JointState": [
        ("header", _HEADER),
        ("name", Many("string")),
        ("position", Many("f8")),
        ("velocity", Many("f8")),
        ("effort", Many("f8")),
    ],
    "geometry_msgs/msg/PoseStamped": [("header", _HEADER), ("pose", [("position", _XYZ), ("orientation", _XYZW)])],
    "geometry_msgs/msg/PointStamped": [("header", _HEADER), ("point", _XYZ)],
    "geometry_msgs/msg/Vector3Stamped": [("header", _HEADER), ("vector", _XYZ)],
    "geometry_msgs/msg/WrenchStamped": [("header", _HEADER), ("wrench", [("force", _XYZ), ("torque", _XYZ)])],
    "sensor_msgs/msg/Range": [
        ("header", _HEADER),
        ("radiation_type", "u1"),
        ("field_of_view", "f4"),
        ("min_range", "f4"),
        ("max_range", "f4"),
        ("range", "f4"),
        ("variance", "f4"),
    ],
    "sensor_msgs/msg/Temperature": [("header", _HEADER), ("temperature", "f8"), ("variance", "f8")],
    "std_msgs/msg/String": [("data", "string")],
}
_NUMBERS = {
    "bool": "u1", "byte": "u1", "octet": "u1", "uint8": "u1", "int8": "i1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip


def fields_of(type_name: str, schemas: Mapping[str, str]) -> Fields | None:
    """The fields of a message type; None for one that is not known, or holds more than numbers and texts.

    schemas: definitions that a bag brings along, by type.
    """
    if type_name in KNOWN:
        return KNOWN[type_name]
    from modcal_msgs_py.types import store_with  # reading the definitions of all types takes half a second

    return _read_off(store_with(dict(schemas)), type_name)


@cache
def _read_off(store: Any, type_name: str) -> Fields | None:
    if type_name not in store.fielddefs:
        return None
    try:
        return _fields(store, type_name)
    except KeyError:
        return None


def _fields(store: Any, type_name: str) -> Fields:
    return [(name, _kind(store, described)) for name, described in store.fielddefs[type_name][1]]


def _kind(store: Any, described: Any) -> Kind:
    """Raises KeyError for what is neither a number nor a text."""
    node, what = described
    if node.name == "BASE":
        return "string" if what[0] == "string" else _NUMBERS[what[0]]
    if node.name == "NAME":
        return _fields(store, what)
    inner, count = what
    return Many(_kind(store, inner), count if node.name == "ARRAY" else None)

"""The fields of message types, as ``layout`` reads them.

Those of the contract's topics are written down here; others come out of the definitions that bags bring along.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from modcal_msgs_py.layout import Fields, Kind, Many

_HEADER: Fields = [("stamp", [("sec", "i4"), ("nanosec", "u4")]), ("frame_id", "string")]
_XYZ: Fields = [("x", "f8"), ("y", "f8"), ("z", "f8")]
_XYZW: Fields = [*_XYZ, ("w", "f8")]
_POSE: Fields = [("position", _XYZ), ("orientation", _XYZW)]
_POSE_WITH_COVARIANCE: Fields = [("pose", _POSE), ("covariance", Many("f8", 36))]
_TRANSFORM: Fields = [
    ("header", _HEADER),
    ("child_frame_id", "string"),
    ("transform", [("translation", _XYZ), ("rotation", _XYZW)]),
]
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
    "geometry_msgs/msg/PoseWithCovarianceStamped": [("header", _HEADER), ("pose", _POSE_WITH_COVARIANCE)],
    "nav_msgs/msg/Odometry": [
        ("header", _HEADER),
        ("child_frame_id", "string"),
        ("pose", _POSE_WITH_COVARIANCE),
        ("twist", [("twist", [("linear", _XYZ), ("angular", _XYZ)]), ("covariance", Many("f8", 36))]),
    ],
    "geometry_msgs/msg/TransformStamped": _TRANSFORM,
    "tf2_msgs/msg/TFMessage": [("transforms", Many(_TRANSFORM))],
}
_NUMBERS = {
    "bool": "u1", "byte": "u1", "octet": "u1", "uint8": "u1", "int8": "i1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
_MAX_DEPTH, _MAX_FIELDS = 32, 4096  # of types in types


def fields_of(type_name: str, schemas: Mapping[str, str]) -> Fields | None:
    """The fields of a message type; None for one that is not known, or holds more than numbers and texts.

    schemas: definitions that a bag brings along, by type.
    """
    if type_name in KNOWN:
        return KNOWN[type_name]
    from modcal_msgs_py.types import jazzy  # reading the definitions of all types takes half a second

    if type_name in jazzy().fielddefs:
        return expanded(type_name, "")
    return expanded(type_name, schemas[type_name]) if type_name in schemas else None


@lru_cache(maxsize=256)
def expanded(type_name: str, text: str) -> Fields | None:
    """The fields of a type of Jazzy (no text), or of one that a text defines."""
    from modcal_msgs_py.types import definitions, jazzy

    own = definitions(type_name, text) if text else {}
    try:
        return _Expansion({**own, **jazzy().fielddefs} if own else jazzy().fielddefs).fields(type_name, 0)
    except (KeyError, ValueError):
        return None


@dataclass
class _Expansion:
    """Fields of types in fields of types, within bounds that no real type meets."""

    known: Mapping[str, Any]
    count: int = 0

    def fields(self, type_name: str, depth: int) -> Fields:
        """Raises KeyError for what is neither a number nor a text, ValueError for what has no end."""
        described = self.known[type_name][1]
        self.count += len(described)
        if depth > _MAX_DEPTH or self.count > _MAX_FIELDS:
            raise ValueError(f"{type_name} is deeper or larger than any message")
        return [(name, self.kind(what, depth)) for name, what in described]

    def kind(self, described: Any, depth: int) -> Kind:
        node, what = described
        if node.name == "BASE":
            return "string" if what[0] == "string" else _NUMBERS[what[0]]
        if node.name == "NAME":
            return self.fields(what, depth + 1)
        inner, count = what
        return Many(self.kind(inner, depth), count if node.name == "ARRAY" else None)

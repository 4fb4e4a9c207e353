"""Bodies with markers as data: our own form, and the tag bundles that apriltag_ros reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from modcal_core.camera.bundle import (
    APRILTAG_ORDER,
    ARUCO_ORDER,
    BUNDLE,
    PLACE_M,
    PRINT,
    TURN_RAD,
    BundleMarker,
    MarkerBundle,
    body_scale,
)
from modcal_core.errors import BadTable
from modcal_core.geometry import so3

TAG_BUNDLES = "tag_bundles"  # of apriltag_ros, beside standalone_tags
_FAMILY = "DICT_APRILTAG_36h11"  # apriltag_ros's own, unless its other settings say otherwise
_ORDERS = {"aruco": ARUCO_ORDER, "apriltag": APRILTAG_ORDER}
_UNIT = 1e-3  # how far from 1 a quaternion's length may be, which is written with four digits


def bundle_from_data(data: Mapping[str, Any], source: str) -> MarkerBundle:
    """The body that our form of a target file describes. Raises BadTable."""
    markers = [_marker(one, source) for one in data.get("markers") or ()]
    markers += [BundleMarker(int(one["id"]), _xyz(one["xyz"])) for one in data.get("points") or ()]
    order = data.get("corner_order", "aruco")
    order = _ORDERS.get(order, ()) if isinstance(order, str) else tuple(str(name) for name in order)
    size = data.get("size_tolerance")
    printed = float(data.get("print_tolerance", PRINT))
    if not (size is None or 0.0 < float(size) < 1.0) or not 0.0 < printed < 1.0:
        raise BadTable(source, "has a size tolerance that is none", "give a relative one, such as 0.002")
    return MarkerBundle(
        tuple(markers),
        body_scale(None if size is None else float(size), printed=printed),
        float(data.get("tolerance_m", PLACE_M)),
        float(data.get("tolerance_rad", TURN_RAD)),
        order,
        str(data.get("dictionary", "")),
        str(data.get("name", ""))[:60],
        normal_m=None if (normal := data.get("tolerance_normal_m")) is None else float(normal),
    )


def bundle_of_tags(data: Mapping[str, Any], source: str) -> MarkerBundle:
    """The only bundle in the settings of apriltag_ros, ROS 1's form. Raises BadTable."""
    bundles = list(data[TAG_BUNDLES] or ())
    if len(bundles) != 1:
        raise BadTable(source, f"has {len(bundles)} tag bundles, one is read", "give the one that is on the arm")
    markers = []
    for one in bundles[0]["layout"]:
        quaternion = [float(one.get(key, 1.0 if key == "qw" else 0.0)) for key in ("qx", "qy", "qz", "qw")]
        xyz = [float(one.get(key, 0.0)) for key in ("x", "y", "z")]
        markers.append(BundleMarker(int(one["id"]), _xyz(xyz), _unit(quaternion, source), float(one["size"])))
    name = str(bundles[0].get("name", ""))[:60]
    return MarkerBundle(tuple(markers), body_scale(None), corners=APRILTAG_ORDER, dictionary=_FAMILY, name=name)


def bundle_to_data(target: MarkerBundle) -> dict[str, Any]:
    """The body as nested dictionaries, in our form."""
    body, printed = (float(v) for v in np.sqrt(np.diag(target.scale.covariance)))
    out: dict[str, Any] = {"modcal_target": 1, "type": BUNDLE}
    out |= {"name": target.name} if target.name else {}
    out |= {"tolerance_m": target.place_m, "tolerance_rad": target.turn_rad, "corner_order": list(target.corners)}
    out |= {} if target.normal_m is None else {"tolerance_normal_m": target.normal_m}
    out |= {"size_tolerance": body} if target.scale.measured else {}
    out["print_tolerance"] = printed
    out |= {"dictionary": target.dictionary} if target.dictionary else {}
    out["markers"] = [
        {"id": m.id, "size_m": m.size, "xyz": list(m.xyz), "quaternion": list(m.quaternion)}
        for m in target.markers
        if m.size
    ]
    out["points"] = [{"id": m.id, "xyz": list(m.xyz)} for m in target.markers if not m.size]
    return out


def _marker(one: Mapping[str, Any], source: str) -> BundleMarker:
    name = f"{source}: marker {int(one['id'])}"
    if "quaternion" in one and "rpy" in one:
        raise BadTable(name, "has a quaternion and rpy", "give one of the two")
    rotation = one.get("quaternion")
    if rotation is None:
        rotation = so3.to_quaternion(so3.from_rpy(np.array(one.get("rpy", [0.0, 0.0, 0.0]), dtype=float))).tolist()
    return BundleMarker(int(one["id"]), _xyz(one["xyz"]), _unit(rotation, name), float(one["size_m"]))


def _xyz(values: Sequence[Any]) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z


def _unit(values: Sequence[Any], source: str) -> tuple[float, float, float, float]:
    x, y, z, w = (float(v) for v in values)
    length = (x * x + y * y + z * z + w * w) ** 0.5
    if not abs(length - 1.0) < _UNIT:
        raise BadTable(source, f"has a quaternion of length {length:.3g}", "give x, y, z, w of length 1")
    return x / length, y / length, z / length, w / length

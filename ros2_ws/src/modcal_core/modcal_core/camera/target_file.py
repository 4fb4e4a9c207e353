"""Targets as data: our own form, which ``modcal target`` writes, and Kalibr's YAML.

The rulers on a printed sheet have a nominal length; what somebody measured of them says how large the sheet came out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.camera.bundle import (
    APRIL_GRID,
    APRILTAG_ORDER,
    ARUCO_GRID,
    ARUCO_ORDER,
    BUNDLE,
    CHARUCO,
    CHESSBOARD,
    PLACE_M,
    PRINT,
    TAG,
    TURN_RAD,
    BundleMarker,
    MarkerBundle,
    PrintedTarget,
    PrintScale,
    body_scale,
    require,
)
from modcal_core.errors import BadTable, refusing
from modcal_core.files import read_yaml
from modcal_core.geometry import so3

_ORDERS = {"aruco": ARUCO_ORDER, "apriltag": APRILTAG_ORDER}
_NORMAL = "tolerance_normal_m"
_UNIT = 1e-3  # how far from 1 a quaternion's length may be, which is written with four digits


def bundle_from_data(data: Mapping[str, Any], source: str) -> MarkerBundle:
    """The body that our form of a target file describes. Raises BadTable."""
    markers = []
    for one in data.get("markers") or ():
        name = f"{source}: marker {int(one['id'])}"
        require(not {"quaternion", "rpy"} <= set(one), name, "has a quaternion and rpy", "give one of the two")
        turn = one.get("quaternion", so3.to_quaternion(so3.from_rpy(np.array(one.get("rpy", [0.0] * 3), dtype=float))))
        markers.append(_marker(one["id"], one["xyz"], turn, one["size_m"], name))
    markers += [_marker(one["id"], one["xyz"], (0, 0, 0, 1), 0, source) for one in data.get("points") or ()]
    order = data.get("corner_order", "aruco")
    order = _ORDERS.get(order, ()) if isinstance(order, str) else tuple(str(name) for name in order)
    size, normal_m = (None if (v := data.get(key)) is None else float(v) for key in ("size_tolerance", _NORMAL))
    printed = float(data.get("print_tolerance", PRINT))
    usual = (size is None or 0.0 < size < 1.0) and 0.0 < printed < 1.0
    require(usual, source, "has a size tolerance that is none", "give a relative one, such as 0.002")
    return MarkerBundle(
        tuple(markers),
        body_scale(size, printed=printed),
        float(data.get("tolerance_m", PLACE_M)),
        float(data.get("tolerance_rad", TURN_RAD)),
        order,
        str(data.get("dictionary", "")),
        str(data.get("name", ""))[:60],
        normal_m=normal_m,
    )


def _marker(number: Any, xyz: Sequence[Any], quaternion: Sequence[Any], size: Any, source: str) -> BundleMarker:
    x, y, z = (float(v) for v in xyz)
    a, b, c, w = turn = [float(v) for v in quaternion]
    length = float(np.linalg.norm(turn))
    said = f"has a quaternion of length {length:.3g}"
    require(abs(length - 1.0) < _UNIT, source, said, "give x, y, z, w of length 1")
    return BundleMarker(int(number), (x, y, z), (a / length, b / length, c / length, w / length), float(size))


FORMAT = 1  # of the file
RULER_STD_M = 3e-4  # how well one reads a ruler against two fine lines: a third of its millimetre
_OFF = 0.1  # a sheet farther from its stated size was measured in another unit
_KINDS = (CHARUCO, CHESSBOARD, ARUCO_GRID, APRIL_GRID, TAG)
_REMEDY = "give a target file as modcal target writes it, Kalibr's aprilgrid.yaml, or a bundle (docs/camera.md)"
_APRIL = "DICT_APRILTAG_36h11"  # the family of Kalibr's grids


def read_target(path: Path) -> PrintedTarget:
    """The printed sheet in a file of ours or of Kalibr's. Raises BadTable, for a body with markers too."""
    target = read_any_target(path)
    if isinstance(target, PrintedTarget):
        return target
    said = "is a body with markers, which is read from a CSV of its points only"
    raise BadTable(str(path), said, "use modcal calibrate --images FILE.csv, or give a printed sheet")


def read_any_target(path: Path) -> PrintedTarget | MarkerBundle:
    """The printed sheet, or the body with markers, in a file. Raises BadTable."""
    return target_from_data(read_yaml(path), str(path))


@refusing
def target_from_data(data: Any, source: str = "target") -> PrintedTarget | MarkerBundle:
    """The sheet or body that this data describes; raises BadTable, naming the source."""
    if not isinstance(data, Mapping) or not {"modcal_target", "target_type"} & set(data):
        raise BadTable(source, "is not a target file", _REMEDY)
    if "target_type" in data:
        return _from_kalibr(data, source)
    if data.get("type") == BUNDLE:
        return bundle_from_data(data, source)
    ours, kind = data["modcal_target"], data.get("type")
    require(ours == FORMAT, source, f"has format {ours}, {FORMAT} is read", "print the target again")
    require(kind in _KINDS, source, f"type {str(kind)[:40]} is not known", f"use {', '.join(_KINDS)}")
    return PrintedTarget(
        str(data["type"]),
        int(data.get("columns", 1)),
        int(data.get("rows", 1)),
        float(data["square_m"]),
        float(data.get("marker_m", data.get("gap_m", 0.0))),
        str(data.get("dictionary", "")),
        int(data.get("first_id", 0)),
        _scale(data.get("rulers"), source),
    )


def target_to_data(target: PrintedTarget, rulers_m: tuple[float, float] | None = None) -> dict[str, Any]:
    """The target as nested dictionaries; rulers_m: nominal lengths of the rulers on the sheet, along x and y."""
    grid = target.kind in (ARUCO_GRID, APRIL_GRID)
    out: dict[str, Any] = {"modcal_target": FORMAT, "type": target.kind}
    out |= {"columns": target.columns, "rows": target.rows, "square_m": target.square}
    if target.marker:
        out["gap_m" if grid else "marker_m"] = target.marker
    if target.dictionary:
        out |= {"dictionary": target.dictionary, "first_id": target.first_id}
    if rulers_m is not None:
        known = target.scale.measured
        out["rulers"] = {
            "x_m": rulers_m[0],
            "y_m": rulers_m[1],
            "measured_x_m": rulers_m[0] * target.scale.x if known else None,
            "measured_y_m": rulers_m[1] * target.scale.y if known else None,
        }
    return out


def scale_of_rulers(
    nominal: tuple[float, float], measured: tuple[float, float], source: str, std_m: float | None = None
) -> PrintScale:
    """How large a sheet came out whose rulers of these lengths [m], along x and y, measure so much.

    std_m: to what they were measured [m]; None: nobody said so, and it was with a ruler. Raises BadTable for lengths
    that are no print's.
    """
    x, y = (m / n for m, n in zip(measured, nominal, strict=True))
    said = f"rulers of {nominal[0]:g} and {nominal[1]:g} m measure {measured[0]:g} and {measured[1]:g} m"
    near = max(abs(x - 1.0), abs(y - 1.0)) <= _OFF
    require(near, source, said, "give what a ruler shows, in metres, or print at 100 %")
    std = RULER_STD_M if std_m is None else std_m
    known = (std / nominal[0]) ** 2, 0.0, (std / nominal[1]) ** 2
    return PrintScale(x, y, known, True, std_m is None)


def _scale(rulers: Any, source: str) -> PrintScale:
    if not isinstance(rulers, Mapping) or rulers.get("measured_x_m") is None or rulers.get("measured_y_m") is None:
        return PrintScale()
    nominal = float(rulers["x_m"]), float(rulers["y_m"])
    measured = float(rulers["measured_x_m"]), float(rulers["measured_y_m"])
    std = rulers.get("measured_std_m")
    std = None if std is None else float(std)
    small, said = std is None or 0.0 < std < min(nominal), f"rulers were measured to {std or 0.0:g} m"
    require(small, source, said, "give a small length, in metres")
    return scale_of_rulers(nominal, measured, source, std)


def _from_kalibr(data: Mapping[str, Any], source: str) -> PrintedTarget:
    """Kalibr's forms: aprilgrid counts tags, checkerboard counts inner corners."""
    kind = str(data["target_type"])
    if kind == "aprilgrid":
        side, ratio = float(data["tagSize"]), float(data["tagSpacing"])
        low = int(data.get("lowID", 0))
        return PrintedTarget(APRIL_GRID, int(data["tagCols"]), int(data["tagRows"]), side, side * ratio, _APRIL, low)
    if kind == "checkerboard":
        across, down = float(data["colSpacingMeters"]), float(data["rowSpacingMeters"])
        require(across == down, source, f"has squares of {across:g} × {down:g} m", "use a board of squares")
        return PrintedTarget(CHESSBOARD, int(data["targetCols"]) + 1, int(data["targetRows"]) + 1, across)
    raise BadTable(source, f"target_type {kind[:40]} is not read", "use aprilgrid, checkerboard or a ChArUco board")

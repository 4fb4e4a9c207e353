"""Corners of a printed target as a PointCloud2: one point a corner, with u, v, sigma [px] and its number.

The image's width and height stand in every point: who calibrates from corners alone needs them. Messages are those of
rclpy or those of a bag.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from modcal_core.camera.views import BoardView
from modcal_core.errors import BadRecording
from modcal_msgs_py.stamps import seconds, set_seconds

_FLOAT32, _UINT32 = 7, 6  # of sensor_msgs/PointField
_FIELDS = {  # name: (kind of number, its PointField type)
    "u": ("<f4", _FLOAT32),
    "v": ("<f4", _FLOAT32),
    "sigma": ("<f4", _FLOAT32),
    "id": ("<u4", _UINT32),
    "image_width": ("<u4", _UINT32),
    "image_height": ("<u4", _UINT32),
}
_BYTES = 4  # of each number
CORNER = np.dtype([(name, kind) for name, (kind, _) in _FIELDS.items()])
_MAX = 40_000  # corners of one image; a grid of 200 × 200


def fill_corners(message: Any, field: Any, view: BoardView, size: tuple[int, int], frame: str) -> Any:
    """The corners of a view of an image of this size, in the frame of its camera. field: the PointField type."""
    rows = np.zeros(len(view), CORNER)
    rows["u"], rows["v"] = view.pixels.T
    rows["sigma"] = np.sqrt(0.5 * np.trace(view.cov, axis1=1, axis2=2))
    rows["id"] = view.ids
    rows["image_width"], rows["image_height"] = size
    message.header.frame_id = frame
    set_seconds(message.header.stamp, view.stamp)
    message.height, message.width = 1, len(rows)
    message.point_step, message.row_step = CORNER.itemsize, CORNER.itemsize * len(rows)
    message.is_dense, message.is_bigendian = True, False
    message.fields = [
        field(name=name, offset=_BYTES * i, datatype=number, count=1)
        for i, (name, (_, number)) in enumerate(_FIELDS.items())
    ]
    message.data = rows.tobytes()
    return message


def read_corners(message: Any) -> tuple[BoardView, tuple[int, int]]:
    """(the view in a message, size of its image [px]). Raises BadRecording for a cloud of anything else."""
    count = int(message.width) * int(message.height)
    there = {str(f.name): (int(f.offset), int(f.datatype)) for f in message.fields}
    known = all(name in there and there[name][1] == number for name, (_, number) in _FIELDS.items())
    if not known or bool(message.is_bigendian):
        raise BadRecording("corners", f"hold {', '.join(there)[:80]}", "publish the corners of board_detector")
    step = int(message.point_step)
    data = bytes(message.data)
    inside = all(0 <= there[name][0] <= step - _BYTES for name in _FIELDS)
    if not 0 < count <= _MAX or not inside or len(data) < step * count:
        raise BadRecording("corners", f"{count} points in {len(data)} bytes", "publish the corners of board_detector")
    kinds, offsets = [kind for kind, _ in _FIELDS.values()], [there[name][0] for name in _FIELDS]
    layout = np.dtype({"names": list(_FIELDS), "formats": kinds, "offsets": offsets, "itemsize": step})
    rows = np.frombuffer(data, layout, count)
    pixels = np.stack([rows["u"], rows["v"]], axis=1).astype(float)
    sigma = rows["sigma"].astype(float)
    if not np.isfinite(pixels).all() or not (sigma > 0.0).all() or not np.isfinite(sigma).all():
        raise BadRecording("corners", "hold numbers that are not finite, or no sigma", "leave such corners out")
    ids = rows["id"].astype(int)
    if len(np.unique(ids)) < len(ids):
        raise BadRecording("corners", "hold a number twice", "publish the corners of one target")
    stamp = seconds(message.header.stamp)
    size = int(rows["image_width"][0]), int(rows["image_height"][0])
    cov = (sigma**2)[:, None, None] * np.eye(2)
    return BoardView(f"{stamp:.6f}", ids, pixels, cov, stamp=stamp), size

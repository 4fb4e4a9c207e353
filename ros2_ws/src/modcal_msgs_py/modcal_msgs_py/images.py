"""Images in bags: raw and compressed ones, and what a camera says of its lens, one message at a time.

A bag may hold hours of images, so none is decoded here: what comes back has the bytes as they were sent.

The image's width and height stand in every point: who calibrates from corners alone needs them. Messages are those of
rclpy or those of a bag.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modcal_core.camera import BoardView
from modcal_core.errors import BadRecording
from modcal_core.measurements import Listed
from modcal_msgs_py.bag_open import packed_messages
from modcal_msgs_py.readings import seconds, set_seconds

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
IMAGES = (IMAGE, COMPRESSED)
TAGS = "apriltag_msgs/msg/AprilTagDetectionArray"  # no part of ROS's messages: read by the definition in the bag
CLOUD = "sensor_msgs/msg/PointCloud2"  # of corners, where its points have their fields
_MAX_BYTES = 1 << 28  # of one image
_LARGEST = 1 << 15  # px a side


@dataclass(frozen=True)
class RawImage:
    """An image as it was sent. stamp: [s]. encoding: of a raw one as ROS names it, of a compressed one its format, with
    ``compressed`` set. data: bytes, rows of ``step`` bytes of a raw one.
    """

    stamp: float
    encoding: str
    width: int
    height: int
    step: int
    bigendian: bool
    data: NDArray[np.uint8]
    compressed: bool = False
    frame: str = ""


def image_topics(listed: tuple[Listed, ...]) -> tuple[Listed, ...]:
    """The topics with images, among those of a recording; depth left out as far as names tell."""
    return tuple(one for one in listed if one.type_name in IMAGES and one.count and "depth" not in one.topic.lower())


def tag_topics(listed: tuple[Listed, ...]) -> tuple[Listed, ...]:
    """The topics with corners of AprilTags that a detector found, among those of a recording."""
    return tuple(one for one in listed if one.type_name == TAGS and one.count)


def corner_topics(path: Path, listed: tuple[Listed, ...]) -> tuple[Listed, ...]:
    """The topics with corners as board_detector publishes them: clouds of which a point has a number and a sigma."""
    clouds = (one for one in listed if one.type_name == CLOUD and one.count)
    return tuple(one for one in clouds if _has_corners(next(read_messages(path, one.topic), None)))


def _has_corners(first: tuple[float, Any] | None) -> bool:
    fields = getattr(first[1], "fields", ()) if first is not None else ()
    return {"u", "v", "sigma", "id"} <= {str(field.name) for field in fields}


def chosen_topic(listed: tuple[Listed, ...], asked: str | None, source: str, others: tuple[Listed, ...] = ()) -> Listed:
    """The topic with the images to use. Raises BadRecording where there is none, or several and none was asked for.

    others: with corners that were found already, which serve where there are no images or they are asked for.
    """
    found = image_topics(listed)
    found = found + others if asked is not None else found or others
    if asked is not None:
        for one in found:
            if one.topic.strip("/") == asked.strip("/"):
                return one
        said = f"holds no images of topic {asked}"
        there = ", ".join(one.topic for one in found)
        raise BadRecording(source, said, f"give one of {there}" if there else "record sensor_msgs/msg/Image")
    if not found:
        raise BadRecording(source, "holds no images", "record Image or CompressedImage, or leave out --target")
    if len(found) > 1:
        # one camera often sends the same image raw and compressed
        roots = {one.topic.removesuffix("/compressed") for one in found}
        if len(roots) == 1:
            return min(found, key=lambda one: one.type_name == COMPRESSED)
        said = f"holds images of {len(found)} topics: {', '.join(one.topic for one in found)}"
        raise BadRecording(source, said, "choose one with --image-topic, further ones with --also-camera")
    return found[0]


def info_topic(listed: tuple[Listed, ...], topic: str) -> str | None:
    """The topic of camera_info that goes with a topic of images: the one beside it."""
    beside = topic.removesuffix("/compressed").rpartition("/")[0] + "/camera_info"
    return next((one.topic for one in listed if one.type_name == CAMERA_INFO and one.topic == beside), None)


def size_of(path: Path, listed: tuple[Listed, ...], topic: str) -> tuple[int, int] | None:
    """Width and height [px] of the images that detections of this topic are of: by the camera_info beside it, or the
    only one there is; None where nothing says so.
    """
    infos = [one.topic for one in listed if one.type_name == CAMERA_INFO]
    name = info_topic(listed, topic) or (infos[0] if len(infos) == 1 else None)
    for _, message in read_messages(path, name) if name is not None else ():
        size = int(message.width), int(message.height)
        return size if all(0 < side <= _LARGEST for side in size) else None
    return None


def stamps_of(path: Path, topic: str) -> NDArray[np.float64]:
    """Stamps of all messages of a topic that begin with a header, in order [s]; when received, where they have none."""
    out = []
    for message in packed_messages(path, {topic}):
        if len(data := message.cdr) >= 12:
            seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
            out.append(_stamp(seconds, nanoseconds, 1e-9 * message.received_ns))
    return np.unique(np.array(out, dtype=float))


def read_messages(path: Path, topic: str) -> Iterator[tuple[float, Any]]:
    """(when received [s], message) of one topic of a bag; what cannot be decoded is passed over.

    Raises BadRecording for what is no bag.
    """
    from modcal_msgs_py.layout import store_with  # which takes as long to import as a small bag to read

    for one in packed_messages(path, {topic}):
        try:
            store = store_with(one.type_name, one.definition)
            yield 1e-9 * one.received_ns, store.deserialize_cdr(one.cdr, one.type_name)
        except Exception:  # the decoder raises whatever the bytes lead it to
            continue


def _stamp(seconds: int, nanoseconds: int, received: float) -> float:
    """Stamp of a header [s], or the time of receipt where it is not set."""
    return float(seconds) + 1e-9 * float(nanoseconds) if seconds or nanoseconds else received


def stamp_of(message: Any, received: float) -> float:
    """Stamp of a message's header [s], or the time of receipt where it is not set."""
    return _stamp(int(message.header.stamp.sec), int(message.header.stamp.nanosec), received)


def raw_image(message: Any, received: float = 0.0) -> RawImage | None:
    """The image in a message, None where it cannot be one. received: when [s], for headers without a stamp."""
    stamp = stamp_of(message, received)
    data = message.data if isinstance(message.data, np.ndarray) else np.frombuffer(bytes(message.data), np.uint8)
    data = np.asarray(data, dtype=np.uint8)
    frame = str(message.header.frame_id)
    if len(data) > _MAX_BYTES:
        return None
    if hasattr(message, "format"):
        return RawImage(stamp, str(message.format), 0, 0, 0, False, data, True, frame)
    w, h, step = int(message.width), int(message.height), int(message.step)
    if not (0 < w <= _LARGEST and 0 < h <= _LARGEST) or step < w or len(data) < step * (h - 1) + w:
        return None
    return RawImage(stamp, str(message.encoding), w, h, step, bool(message.is_bigendian), data, False, frame)


def lens_data(message: Any) -> dict[str, Any] | None:
    """A camera_info message as its YAML file has it; None where the camera was never calibrated (all zero)."""
    K = [float(x) for x in (message.k if hasattr(message, "k") else message.K)]
    if len(K) != 9 or not np.isfinite(K).all() or K[0] <= 0.0:
        return None
    d = [float(x) for x in (message.d if hasattr(message, "d") else message.D)]
    return {
        "image_width": int(message.width),
        "image_height": int(message.height),
        "distortion_model": str(message.distortion_model),
        "camera_matrix": {"rows": 3, "cols": 3, "data": K},
        "distortion_coefficients": {"rows": 1, "cols": len(d), "data": d},
    }


# --- Corners of a printed target as a PointCloud2: one point a corner, with u, v, sigma [px] and its number

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

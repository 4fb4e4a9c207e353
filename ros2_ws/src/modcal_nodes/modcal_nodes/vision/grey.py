"""Grey images of 8 bits from messages, raw or compressed; what cannot be used is said in words."""

from __future__ import annotations

import cv2
import numpy as np

from modcal_msgs_py import RawImage
from modcal_nodes.vision.images import grey_of_file, in_eight_bits, is_mosaic

_COLOURS = {
    "rgb8": cv2.COLOR_RGB2GRAY,
    "bgr8": cv2.COLOR_BGR2GRAY,
    "rgba8": cv2.COLOR_RGBA2GRAY,
    "bgra8": cv2.COLOR_BGRA2GRAY,
    "8UC3": cv2.COLOR_BGR2GRAY,
    "8UC4": cv2.COLOR_BGRA2GRAY,
}
_BAYER = {  # as ROS names the first two pixels of the first two rows; OpenCV names the second ones
    "bayer_rggb8": cv2.COLOR_BayerBG2GRAY,
    "bayer_bggr8": cv2.COLOR_BayerRG2GRAY,
    "bayer_gbrg8": cv2.COLOR_BayerGR2GRAY,
    "bayer_grbg8": cv2.COLOR_BayerGB2GRAY,
}
_YUV = {
    "yuv422": cv2.COLOR_YUV2GRAY_UYVY,
    "uyvy": cv2.COLOR_YUV2GRAY_UYVY,
    "yuv422_yuy2": cv2.COLOR_YUV2GRAY_YUY2,
    "yuyv": cv2.COLOR_YUV2GRAY_YUY2,
}
_GREY = ("mono8", "8UC1")
_DEEP = ("mono16", "16UC1")  # grey of 16 bits; a depth image is one too, and shows no target
_CODES = {**_COLOURS, **_BAYER, **_YUV}
_CHANNELS = {  # bytes a pixel
    **dict.fromkeys((*_GREY, *_BAYER), 1),
    **dict.fromkeys((*_YUV, *_DEEP), 2),
    **{name: 4 if "a8" in name or name == "8UC4" else 3 for name in _COLOURS},
}


def grey_of(image: RawImage) -> tuple[np.ndarray | None, str]:
    """(grey image (h, w) of 8 bits, what was done to it, or nothing) or (None, why not and what to do)."""
    if image.compressed:
        return _unpacked(image)
    encoding = image.encoding
    if encoding not in _DEEP and ("16" in encoding or "32" in encoding):
        return None, f"is of encoding {encoding}, of which none but mono16 is read: publish mono8 or rgb8"
    if encoding not in _CHANNELS:
        return None, f"is of encoding {encoding[:30]}, which is not read: publish mono8 or rgb8"
    channels = _CHANNELS[encoding]
    if image.step < image.width * channels or len(image.data) < image.step * image.height:
        return None, "has fewer bytes than its size says: record it again"
    rows = image.data[: image.step * image.height].reshape(image.height, image.step)
    pixels = np.ascontiguousarray(rows[:, : image.width * channels])
    if encoding in _CODES:
        if channels > 1:
            pixels = pixels.reshape(image.height, image.width, channels)
        return np.asarray(cv2.cvtColor(pixels, _CODES[encoding])), ""
    grey = pixels.view(">u2" if image.bigendian else "<u2").astype(np.uint16) if encoding in _DEEP else pixels
    if is_mosaic(grey):
        return None, "is a raw Bayer mosaic sent as grey: debayer it, or publish its encoding"
    return in_eight_bits(grey)


def _unpacked(image: RawImage) -> tuple[np.ndarray | None, str]:
    if "compressedDepth" in image.encoding:
        return None, "is a depth image: choose the camera's own topic with --image-topic"
    try:
        found = cv2.imdecode(image.data, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        found = None
    if found is None:
        return None, "cannot be unpacked: record it again"
    return grey_of_file(found, "publish 8 bits")

"""Corners of a body's markers: in an image, or among the detections of a finder of tags.

Markers on the faces of a body show one by one in whatever way it is turned, and one is enough. A marker's corners are
numbered as its finder has them; whether the target file states that order is found against the arm (body_start).

``apriltag_msgs/AprilTagDetectionArray`` is no part of ROS's own messages: it is read by the definition that the bag
brings. Of a detection its corners count; its pose has no covariance, and flips.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from modcal_core.camera import (
    APRIL_GRID,
    CHARUCO,
    CHESSBOARD,
    MARKER_CORNERS,
    TAG,
    BoardView,
    MarkerBundle,
    PrintedTarget,
)
from modcal_core.errors import BadTable
from modcal_core.geometry import Array
from modcal_nodes.vision.detection import (
    BLURRED_PX,
    Detection,
    corner_covariance,
    edge_width,
    grey_noise,
    in_order,
    marker_detector,
    off_flat,
    too_few,
    window_of_side,
)


def detect_body(grey: np.ndarray, body: MarkerBundle, name: str) -> Detection:
    """The corners of the body's markers in a grey image (h, w) of 8 bits. Raises BadTable where no one says which
    dictionary they are of.
    """
    if not body.dictionary:
        remedy = "add dictionary: DICT_4X4_50, or whichever they are of, or give a CSV of corners"
        raise BadTable(body.label, "has no dictionary of markers to look for in images", remedy)
    corners, ids, _ = marker_detector(body.dictionary).detectMarkers(grey)
    numbers = [] if ids is None else [int(i) for i in np.asarray(ids).ravel()]
    found = body_corners(body, numbers, [np.asarray(c, dtype=float).reshape(4, 2) for c in corners])
    if isinstance(found, Detection):
        return found
    points, pixels = found
    half = window_of_side(float(np.median(np.linalg.norm(np.diff(pixels.reshape(-1, 4, 2), axis=1), axis=2))))
    width = edge_width(grey, pixels, half)
    if width > BLURRED_PX:
        return Detection(None, f"is blurred: edges are {width:.0f} px wide", "hold still, focus, or add light")
    cov = corner_covariance(grey, pixels, half, grey_noise(grey))
    return Detection(BoardView(name, points, pixels, cov, width))


def body_corners(
    body: MarkerBundle, numbers: Sequence[int], quads: Sequence[Array]
) -> tuple[np.ndarray, Array] | Detection:
    """(points of the body (4 m,), pixels (4 m, 2)) of markers with these numbers and corners (4, 2) each; why there are
    none, where there are none. A number that stands twice is another's once, and nobody knows which.
    """
    count = Counter(numbers)
    points: list[int] = []
    pixels: list[Array] = []
    for number, quad in zip(numbers, quads, strict=True):
        own = [body.point(number, corner) for corner in range(MARKER_CORNERS)]
        if count[number] == 1 and None not in own and np.isfinite(quad).all():
            points += [p for p in own if p is not None]
            pixels.append(quad)
    if not points:
        return Detection(None, "shows no marker of the body", "check the target's numbers, and bring it into view")
    return np.array(points), np.concatenate(pixels)


_SIGMA_PX = 0.2  # of a corner at which two lines meet that were fitted to a tag's edges
_MAX_TAGS = 10_000  # of one image
_MENDED = 1  # bits of a tag that were read wrong: more, and it may be another


def require_tags(target: PrintedTarget | MarkerBundle) -> None:
    """Raises BadTable for a target that has no tags, or whose tags are inside something else's corners."""
    if isinstance(target, MarkerBundle):
        if not any(one.size for one in target.markers):
            raise BadTable(target.label, "has points only, which are not found in images", "give a CSV of corners")
    elif target.kind in (CHARUCO, CHESSBOARD):
        remedy = "give the target.yaml of a tag or an AprilGrid, or record the images"
        raise BadTable(f"target {target.kind}", "is not what detections of tags show", remedy)


def tag_view(message: Any, target: PrintedTarget | MarkerBundle, name: str) -> Detection:
    """The corners of the target's tags in a message of detections."""
    try:
        if isinstance(target, MarkerBundle):
            return _body_view(message, target, name)
        return _tag_view(message, target, name)
    except (AttributeError, TypeError, ValueError, OverflowError):  # the definition is the bag's own
        return Detection(None, "holds no detections as apriltag_msgs defines them", "record its own messages")


def _body_view(message: Any, body: MarkerBundle, name: str) -> Detection:
    seen = [one for one in list(message.detections)[:_MAX_TAGS] if int(one.hamming) <= _MENDED]
    quads = [np.array([[float(p.x), float(p.y)] for p in one.corners]).reshape(4, 2) for one in seen]
    found = body_corners(body, [int(one.id) for one in seen], quads)
    if isinstance(found, Detection):
        return found
    return _of_tags(name, *found)


def _of_tags(name: str, ids: np.ndarray, pixels: Array) -> Detection:
    return Detection(BoardView(name, ids, pixels, np.tile(_SIGMA_PX**2 * np.eye(2), (len(ids), 1, 1))))


def _tag_view(message: Any, target: PrintedTarget, name: str) -> Detection:
    family = target.dictionary.rpartition("_")[2].lower()
    found, strange = {}, set()
    for one in list(message.detections)[:_MAX_TAGS]:
        own = str(one.family).lower().removeprefix("tag")
        if own and family and own != family:
            strange.add(own)
            continue
        number = int(one.id) - target.first_id
        quad = np.array([[float(p.x), float(p.y)] for p in one.corners])
        if 0 <= number < target.columns * target.rows and quad.shape == (4, 2) and int(one.hamming) <= _MENDED:
            if number in found:
                return Detection(None, f"shows tag {int(one.id)} twice", "show one target only")
            if np.isfinite(quad).all():
                found[number] = quad
    if not found:
        if strange:
            return Detection(None, f"shows tags of family {min(strange)[:20]}, the target has {family}", "check both")
        return Detection(None, "shows no tag of the target", "check the target's numbers")
    numbers = np.array(sorted(found))
    quads = np.stack([found[n] for n in numbers])
    if len(numbers) == 1 and target.kind != TAG:
        return Detection(None, "shows one tag of the grid", "show two or more: they tell which corner is which")
    # from a tag's lower left corner counter-clockwise, as its detector has it; all but an AprilGrid go the other way
    ids, pixels = in_order(target, numbers, quads if target.kind == APRIL_GRID else quads[:, ::-1], either_way=True)
    if (few := too_few(target, ids)) is not None:
        return few
    if (bent := off_flat(target, ids, pixels)) is not None:
        return bent
    return _of_tags(name, ids, pixels)

"""Corners of AprilTags that a detector beside the camera found, from its messages in a bag.

``apriltag_msgs/AprilTagDetectionArray`` is no part of ROS's own messages: it is read by the definition that the bag
brings. Of a detection its corners count; its pose has no covariance, and flips.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from modcal_core.camera.bundle import MarkerBundle
from modcal_core.camera.clean import MIN_CORNERS, enough_corners
from modcal_core.camera.target import APRIL_GRID, CHARUCO, CHESSBOARD, TAG, PrintedTarget
from modcal_core.camera.views import BoardView
from modcal_core.errors import BadTable
from modcal_core.geometry.so3 import Array
from modcal_nodes.vision.body import body_corners, require_body_markers
from modcal_nodes.vision.detect import Detection, in_order, off_flat

_SIGMA_PX = 0.2  # of a corner at which two lines meet that were fitted to a tag's edges
_MAX_TAGS = 10_000  # of one image
_MENDED = 1  # bits of a tag that were read wrong: more, and it may be another


def require_tags(target: PrintedTarget | MarkerBundle) -> None:
    """Raises BadTable for a target that has no tags, or whose tags are inside something else's corners."""
    if isinstance(target, MarkerBundle):
        require_body_markers(target)
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
    ids, pixels = found
    return Detection(BoardView(name, ids, pixels, _covariance(len(ids))))


def _covariance(count: int) -> Array:
    return np.tile(_SIGMA_PX**2 * np.eye(2), (count, 1, 1))


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
    if not enough_corners(target.points[ids]):
        said = f"shows {len(ids)} corners of the target, {MIN_CORNERS} not on one line are needed"
        return Detection(None, said, "bring more of the target into view")
    if (bent := off_flat(target, ids, pixels)) is not None:
        return bent
    return Detection(BoardView(name, ids, pixels, _covariance(len(ids))))

"""Corners of a body's markers: in an image, or among the detections of a finder of tags.

Markers on the faces of a body show one by one in whatever way it is turned, and one is enough. A marker's corners are
numbered as its finder has them; whether the target file states that order is found against the arm (body_start).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from modcal_core.camera.bundle import MarkerBundle
from modcal_core.camera.target import MARKER_CORNERS
from modcal_core.camera.views import BoardView
from modcal_core.errors import BadTable
from modcal_core.geometry.so3 import Array
from modcal_nodes.vision.corner_noise import corner_covariance, edge_width, grey_noise
from modcal_nodes.vision.detect import BLURRED_PX, Detection, marker_detector, window_of_side


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


def require_body_markers(body: MarkerBundle) -> None:
    """Raises BadTable for a body of bare points, which finders of markers do not see."""
    if not any(one.size for one in body.markers):
        raise BadTable(body.label, "has points only, which are not found in images", "give a CSV of corners")

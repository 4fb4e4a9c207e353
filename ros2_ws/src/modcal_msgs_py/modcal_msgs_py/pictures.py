"""Arrows, ellipsoids, dots and texts as markers, each message a whole picture that replaces the one before.

A picture begins with a marker that deletes all others of its topic: whoever listens from now on sees what one who has
listened for hours sees. Stamps are zero, which RViz and Foxglove take for *the newest transform*: what is latched must
be shown in a moving cell as well, long after it was said. ``marker`` is the Marker type.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from modcal_core.geometry.so3 import Array
from modcal_msgs_py.commands import fill_pose
from modcal_msgs_py.objects import as_point
from modcal_msgs_py.stamps import set_seconds

Colour = tuple[float, float, float, float]  # red, green, blue, how solid: 0 to 1
_THINNEST = 1e-5  # m; viewers complain of what has no extent
_GROWING = ((0.13, 0.44, 0.71), (0.98, 0.78, 0.18), (0.84, 0.15, 0.16))  # blue, yellow, red


def colour_of(share: float, solid: float = 1.0) -> Colour:
    """Colour scale from blue (0) through yellow to red (1 and more), distinct for most colour-blind readers."""
    at = 2.0 * float(np.clip(share, 0.0, 1.0))
    low, high = _GROWING[int(at)], _GROWING[min(int(at) + 1, 2)]
    red, green, blue = (a + (at - int(at)) * (b - a) for a, b in zip(low, high, strict=True))
    return red, green, blue, solid


def fill_picture(message: Any, marker: Any, frame: str, parts: Sequence[Any], lifetime: float = 0.0) -> Any:
    """A MarkerArray that shows these markers and nothing else, in one frame.

    lifetime: [s] after which they vanish by themselves; 0: never. No parts: an empty picture.
    """
    begin = marker()
    begin.action = marker.DELETEALL
    for number, part in enumerate(parts):
        part.id = number
        set_seconds(part.lifetime, lifetime)
    message.markers = [begin, *parts]
    for part in message.markers:
        part.header.frame_id = frame
    return message


def arrows(
    marker: Any, space: str, starts: Array, vectors: Array, colours: Sequence[Colour], thickness: float
) -> list[Any]:
    """Arrows from each start (N, 3) along each vector (N, 3) [m], of a shaft so thick [m]. space: their namespace."""
    out = []
    for start, vector, colour in zip(starts, vectors, colours, strict=True):
        one = _shape(marker, marker.ARROW, space, colour)
        head = min(3.0 * thickness, 0.5 * float(np.linalg.norm(vector)))
        one.scale.x, one.scale.y, one.scale.z = thickness, 2.0 * thickness, max(head, _THINNEST)
        one.points = [as_point(one, start), as_point(one, start + vector)]
        out.append(one)
    return out


def ellipsoids(marker: Any, space: str, shapes: Sequence[tuple[Array, Array]], colour: Colour) -> list[Any]:
    """Ellipsoids of these poses (4, 4) and half axes (3,) [m]."""
    out = []
    for T, half in shapes:
        one = _shape(marker, marker.SPHERE, space, colour)
        fill_pose(one.pose, T)
        one.scale.x, one.scale.y, one.scale.z = (max(2.0 * float(h), _THINNEST) for h in half)
        out.append(one)
    return out


def dots(marker: Any, space: str, positions: Array, colour: Colour, diameter: float) -> list[Any]:
    """One marker with a ball at each position (N, 3) [m]; none where there are no positions."""
    if not len(positions):
        return []
    one = _shape(marker, marker.SPHERE_LIST, space, colour)
    one.scale.x = one.scale.y = one.scale.z = diameter
    one.points = [as_point(one, p) for p in positions]
    return [one]


def caption(marker: Any, space: str, position: Array, text: str, height: float) -> Any:
    """Lines of text that face whoever looks, with capital letters so high [m]."""
    one = _shape(marker, marker.TEXT_VIEW_FACING, space, (0.85, 0.85, 0.85, 1.0))
    one.pose.position = as_point(one, position)
    one.scale.z = height
    one.text = text
    return one


def _shape(marker: Any, kind: int, space: str, colour: Colour) -> Any:
    one = marker()
    one.ns, one.type, one.action = space, kind, marker.ADD
    one.pose.orientation.w = 1.0
    one.color.r, one.color.g, one.color.b, one.color.a = colour
    one.frame_locked = True
    return one

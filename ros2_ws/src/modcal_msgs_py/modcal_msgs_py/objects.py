"""What is seen of a handle, from messages, and what is believed of its joint, as messages that any tool shows.

A picture begins with a marker that deletes all others of its topic: whoever listens from now on sees what one who has
listened for hours sees. Stamps are zero, which RViz and Foxglove take for *the newest transform*: what is latched must
be shown in a moving cell as well, long after it was said. ``marker`` is the Marker type.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from modcal_core.articulation import JOINT
from modcal_core.errors import BadCommand
from modcal_core.geometry import Array, so3
from modcal_msgs_py.commands import fill_pose
from modcal_msgs_py.readings import seconds, set_seconds

if TYPE_CHECKING:
    from modcal_core.articulation import JointModel, TrackerState


_UNIT = 0.02  # how far from one the length of a quaternion may be
_PATH_POINTS = 40
_COLOURS = {True: (0.12, 0.44, 0.92), False: (0.69, 0.72, 0.76)}  # trusted, not yet


def seen(message: Any, what: str) -> tuple[Array, Array | None, float]:
    """Position (3,) [m], rotation (3, 3) or None, and stamp [s] of a pose or point with a header.

    Takes PoseStamped, PoseWithCovarianceStamped and PointStamped. Raises BadCommand, naming ``what``, for what is not
    finite, no unit quaternion, or not stamped.
    """
    stamp = seconds(message.header.stamp)
    if stamp <= 0.0:
        raise BadCommand(what, "has no stamp", "make its publisher stamp it")
    if hasattr(message, "point"):
        return _finite([message.point.x, message.point.y, message.point.z], what), None, stamp
    pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
    p, q = pose.position, pose.orientation
    numbers = _finite([p.x, p.y, p.z, q.x, q.y, q.z, q.w], what)
    length = math.sqrt(float(numbers[3:] @ numbers[3:]))
    if abs(length - 1.0) > _UNIT:
        raise BadCommand(what, f"its quaternion has length {length:.4g}", "send a unit quaternion x y z w")
    return numbers[:3], so3.from_quaternion(numbers[3:]), stamp


def _finite(values: list[float], what: str) -> Array:
    numbers = np.array(values, dtype=float)
    if not np.isfinite(numbers).all():
        raise BadCommand(what, "is not finite", "send numbers")
    return numbers


def fill_object_state(message: Any, frame: str, stamp: float, configuration: float) -> Any:
    """A JointState of the object's one joint [rad or m]."""
    message.header.frame_id = frame
    set_seconds(message.header.stamp, stamp)
    message.name, message.position = [JOINT], [float(configuration)]
    return message


def status_values(state: TrackerState) -> dict[str, str]:
    """What is believed, as the keys and values of a DiagnosticStatus."""
    return {
        "kind": state.kind,
        "trusted": str(state.trusted).lower(),
        "event": state.event or "none",
        "ahead_m": f"{state.ahead_m:.6f}",
        "off_m": f"{state.off_m:.6f}",
        "samples": str(state.samples),
        "apart_m": f"{state.apart_m:.6f}",
        "path_m": f"{state.path_m:.6f}",
        "rotations": "handle" if state.follows else "grasp",
        "written": str(state.written or "as expected"),
        **{f"probability_{kind}": f"{p:.4f}" for kind, p in state.probabilities.items()},
    }


def fill_expected(message: Any, frame: str, stamp: float, T: Array) -> Any:
    """A PoseStamped of the handle (4, 4)."""
    message.header.frame_id = frame
    set_seconds(message.header.stamp, stamp)
    fill_pose(message.pose, T)
    return message


def fill_markers(message: Any, marker: Any, frame: str, stamp: float, model: JointModel, reach: tuple[float, float],
                 trusted: bool) -> Any:  # fmt: skip
    """A MarkerArray with the joint's axis as an arrow and the handle's path as a line; blue once it is trusted.

    marker: the Marker type. reach: configurations between which the path is drawn.
    """
    handle = model.start[:3, 3]
    at = model.point if model.turns else handle
    length = 0.3 if not model.turns else max(0.2, 0.5 * min(model.radius, 1.0))
    arrow, line = marker(), marker()
    for number, (one, shape) in enumerate(((arrow, marker.ARROW), (line, marker.LINE_STRIP))):
        one.header.frame_id = frame
        set_seconds(one.header.stamp, stamp)
        one.ns, one.id, one.type, one.action = "object", number, shape, marker.ADD
        one.pose.orientation.w = 1.0
        one.color.r, one.color.g, one.color.b = _COLOURS[trusted]
        one.color.a = 1.0
    arrow.scale.x, arrow.scale.y, arrow.scale.z = 0.01, 0.02, 0.03  # shaft, head, length of the head
    line.scale.x = 0.005
    arrow.points = [as_point(arrow, at), as_point(arrow, at + length * model.axis)]
    line.points = [as_point(line, p) for p in model.position(np.linspace(*reach, _PATH_POINTS))]
    if not model.moves:
        arrow.action = line.action = marker.DELETE
    message.markers = [arrow, line]
    return message


def as_point(marker: Any, p: Array) -> Any:
    """A Point, of the type that a Marker's pose has."""
    point = type(marker.pose.position)()
    point.x, point.y, point.z = (float(v) for v in p)
    return point


# --- Arrows, ellipsoids, dots and texts as markers, each message a whole picture that replaces the one before

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

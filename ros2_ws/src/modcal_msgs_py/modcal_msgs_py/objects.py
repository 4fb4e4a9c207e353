"""What is seen of a handle, from messages, and what is believed of its joint, as messages that any tool shows."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from modcal_core.articulation.urdf import JOINT
from modcal_core.errors import BadCommand
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array
from modcal_msgs_py.commands import fill_pose
from modcal_msgs_py.stamps import seconds, set_seconds

if TYPE_CHECKING:
    from modcal_core.articulation.joints import JointModel
    from modcal_core.articulation.online import TrackerState

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

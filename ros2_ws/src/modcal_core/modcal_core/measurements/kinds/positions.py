"""Poses and points: readings that are positions in the frame of a tracker, the former with an orientation."""

from __future__ import annotations

import numpy as np

from modcal_core.geometry import Array
from modcal_core.measurements.kinds.kind import UNIT, Kind, farthest, lengths, not_unit
from modcal_core.measurements.recording import POINT, POSE, ReadingTrack

_SPREAD = 5.0  # times the arm's reach; millimetres spread a thousand times as far, and an arm itself no more than once
_MILLI = 150.0  # the same from which no other usual unit is as small


class Point(Kind):
    """A target's position in the frame of a tracker; in a frame where it never changes, a ball held in a socket."""

    name = POINT
    topic = "tracker/point"
    message = "geometry_msgs/msg/PointStamped"
    width = 3
    dimensions = 3
    direct = True

    def implausible(self, values: Array, reach: float) -> np.ndarray:
        """Positions farther from the tracker than any arm could be."""
        most = farthest(reach)  # by component first: a square may overflow
        return np.asarray((np.abs(values[:, :3]) > most).any(axis=1) | (lengths(values[:, :3]) > most))

    def complaint(self, track: ReadingTrack, reach: float) -> tuple[str, str] | None:
        """Positions in millimetres."""
        position = track.values[:, :3]
        spread = float(lengths(position - np.median(position, axis=0)).mean())
        far = float(np.linalg.norm(np.median(position, axis=0)))
        if spread <= _SPREAD * reach and far > farthest(reach):
            return _far_off(position, far, spread)
        if spread > _SPREAD * reach:
            said = f"positions spread over {spread:.0f} m and the arm reaches {reach:.2f} m: "
            size = dict(zip("xyz", np.ptp(position, axis=0), strict=True))
            wide = [axis for axis in size if size[axis] > _SPREAD * reach]
            narrow = [axis for axis in size if 1e-3 * reach < size[axis] <= _SPREAD * reach]
            if not wide or not narrow:
                small = "centimetres or inches, or millimetres of a small part of its reach"
                return f"{said}it looks like {'millimetres' if spread > _MILLI * reach else small}", "record metres"
            which = f"column{'s' if len(wide) > 1 else ''} {' and '.join(wide)}"
            look = f"{which} alone, in another unit than the rest (millimetres), or angles (polar coordinates)"
            return f"{said}{look}", "record x, y and z in metres"
        return None


class Pose(Point):
    """A target's pose in the frame of a tracker."""

    name = POSE
    topic = "tracker/pose"
    message = "geometry_msgs/msg/PoseStamped"
    width = 7
    dimensions = 6

    def implausible(self, values: Array, reach: float) -> np.ndarray:
        """Positions too far away, and quaternions that are no rotations."""
        return np.asarray(super().implausible(values, reach) | ~(np.abs(lengths(values[:, 3:]) - 1.0) <= UNIT))

    def complaint(self, track: ReadingTrack, reach: float) -> tuple[str, str] | None:
        """Positions in millimetres, quaternions that are none."""
        remedy = "publish unit quaternions x y z w"
        return super().complaint(track, reach) or not_unit("quaternion", track.values[:, 3:], track.stamps, remedy)


def _far_off(position: Array, far: float, spread: float) -> tuple[str, str]:
    """Refusal of positions that spread like an arm's but are too far from their origin, as in site coordinates."""
    said = f"positions spread over {spread:.2g} m as an arm's do, {far:.0f} m from the origin: coordinates of a site"
    if np.array_equal(position, position.astype(np.float32)):
        step = 1e3 * float(np.spacing(np.float32(far)))
        said += f", in single precision, whose resolution is {step:.2g} mm there"
    return said, "subtract a place near the arm from all positions, in double precision"

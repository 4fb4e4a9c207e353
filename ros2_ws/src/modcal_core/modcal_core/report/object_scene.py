"""A handle's path, axis and lever in three dimensions, for the page of an articulated object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from modcal_core.articulation.joints import PlacedJoint
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.thinning import spread_rows

_MAX_SEEN, _MAX_PLACES = 400, 61  # that a page can show and a person look through
_BEYOND = 0.15  # of the path's size, by which the axis goes on beyond what turns about it
_HAND = 0.06  # m; the strokes of the handle's orientation are half a hand long


@dataclass(frozen=True)
class ObjectScene:
    """All in the frame of the track [m]. seen: measured places of the handle (N, 3). path: of the joint (k, 3).

    handles: orientation and position of the handle on the path (k, 4, 4); oriented: whether the orientation was
    measured. axis: its two ends (2, 3), and feet: the points on it beside the handle (k, 3), both None without an axis
    nearby. said: a sentence for each place on the path. frame: its name. alt: for those who do not see it.
    """

    seen: Array
    path: Array
    handles: Array
    oriented: bool
    axis: Array | None
    feet: Array | None
    said: tuple[str, ...]
    frame: str
    alt: str

    def to_data(self) -> dict[str, Any]:
        """What the page's script draws."""
        lines = [] if self.axis is None else [{"path": np.round(self.axis, 4).tolist(), "name": "axis"}]
        return {
            "points": np.round(self.path, 4).tolist(),
            "stages": [],
            "arms": [[np.round(line, 4).tolist() for line in self._object(k)] for k in range(len(self.path))],
            "shown": list(range(len(self.path))),
            "said": list(self.said),
            "route": True,
            "cloud": np.round(self.seen, 4).tolist(),
            "lines": lines,
            "base": self.frame,
            "local": True,
        }

    def _object(self, k: int) -> list[Array]:
        """Strokes (2, 3) of the object at a place: from the axis to the handle, and the handle's own directions."""
        at = self.handles[k, :3, 3]
        strokes = [] if self.feet is None else [np.stack([self.feet[k], at])]
        if self.oriented:
            strokes += [np.stack([at, at + 0.5 * _HAND * self.handles[k, :3, i]]) for i in range(3)]
        return strokes or [np.stack([at, at])]


def object_scene(
    model: PlacedJoint, a: Array, seen: Array, joint: dict[str, Any], scale: float, frame: str
) -> ObjectScene:
    """The scene of a joint over configurations a (n,), those of samples that are no outliers.

    seen: measured places (n, 3) [m]. joint: its ``axis`` and ``point`` as stated in JSON, where it has them. scale:
    from the unit of configurations to what people read, ° or mm. frame: of the track, may be empty.
    """
    over = np.linspace(a.min(), a.max(), _MAX_PLACES)
    T = model.pose(over)
    path = T[:, :3, 3]
    axis = feet = None
    if joint.get("axis") is not None and model.centre() is not None:
        direction, point = np.asarray(joint["axis"]), np.asarray(joint["point"])
        along = (path - point) @ direction
        feet = point + along[:, None] * direction
        size = float(np.linalg.norm(np.ptp(np.concatenate([path, feet]), axis=0)))
        ends = np.array([along.min() - _BEYOND * size, along.max() + _BEYOND * size])
        axis = point + ends[:, None] * direction
    unit = {"rad": "°", "m": " mm"}.get(model.unit, "")
    said = tuple(
        f"Joint at {scale * x:.1f}{unit}, of {scale * over[0]:.1f} to {scale * over[-1]:.1f}{unit} seen: "
        f"handle at x {p[0]:.3f}, y {p[1]:.3f}, z {p[2]:.3f} m."
        for x, p in zip(over, path, strict=True)
    )
    alt = f"The measured places of the handle, the path of a {model.kind} joint"
    alt += ", its axis, and the handle on it" if axis is not None else ", and the handle on it"
    few = seen[spread_rows(len(seen), _MAX_SEEN)]
    return ObjectScene(few, path, T, bool(model.oriented), axis, feet, said, frame or "the track's frame", alt)

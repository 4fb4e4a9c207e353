"""What a person who moves arm or target should do next, from the images so far: hold still, sharper, tilt, nearer.

A view counts where nothing moves and it differs from those that count already. What is missing is judged as a
calibration will judge it: tilts to all four sides, near and far, every part of the image.
"""

from __future__ import annotations

import numpy as np

from modcal_core.camera.corners import SHAPE, CornerTable
from modcal_core.camera.lens import Lens
from modcal_core.camera.pnp import board_poses
from modcal_core.camera.target import PrintedTarget
from modcal_core.camera.views import BoardView
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array

ENOUGH = 25  # views that a calibration wants
_STILL_PX = 0.7  # motion between two images, in the median: less than a corner is blurred by
_OTHER_PX, _OTHER_DEG, _OTHER_SHARE = 25.0, 6.0, 0.1  # by what a view differs from those before: place, tilt, distance
_SOFT_PX = 3.0  # width of edges of an image in focus and at rest
_TILT_DEG = 18.0  # to a side, that counts as tilted to it
_FARTHER = 1.4  # the farthest over the nearest
_CELLS = 3  # a side, of the image
_USUAL_FOCAL = 0.9  # of the image's width, where nothing is known of the lens: coaching needs no better
_SIDES = {"left": (1, -1.0), "right": (1, 1.0), "up": (0, 1.0), "down": (0, -1.0)}
_PARTS = (("upper left", "upper", "upper right"), ("left", "middle", "right"), ("lower left", "lower", "lower right"))


class Coach:
    """Looks at every image and says what to do. size: of the images [px]. lens: None where it is not known."""

    def __init__(self, target: PrintedTarget, size: tuple[int, int], lens: Lens | None = None) -> None:
        """target: that is shown."""
        focal = _USUAL_FOCAL * size[0]
        middle = [0.5 * (size[0] - 1), 0.5 * (size[1] - 1)]
        self._lens = lens or Lens(np.r_[focal, focal, middle, np.zeros(5)], size)
        self._target, self._size = target, size
        self._last: BoardView | None = None
        self.views: list[Array] = []  # x, y of the middle [px], tilts about x and y [rad], distance [m]
        self._seen = np.zeros((_CELLS, _CELLS), bool)

    def image(self, view: BoardView | None, why: str = "") -> str:
        """What to do after this image. view: None where the target was not found, and why."""
        last, self._last = self._last, view
        if view is None:
            return f"no corners: the image {why}"
        said = f"{len(view)} corners"
        if np.isfinite(view.sharpness) and view.sharpness > _SOFT_PX:
            return f"{said}, edges {view.sharpness:.1f} px wide: focus, or add light"
        if last is None or _motion(last, view) > _STILL_PX:
            return f"{said}: hold still"
        here = self._where(view)
        if all(self._differs(here, other) for other in self.views):
            self.views.append(here)
            x, y = np.clip((view.pixels * _CELLS / np.array(self._size)).astype(int), 0, _CELLS - 1).T
            self._seen[y, x] = True
        missing = self.missing
        if not missing and len(self.views) >= ENOUGH:
            return f"{said}, {len(self.views)} views: enough, calibrate"
        todo = missing[0] if missing else "another posture"
        return f"{said}, {len(self.views)} of {ENOUGH} views; next: {todo}"

    @property
    def missing(self) -> tuple[str, ...]:
        """What no view shows yet, in the order in which it matters."""
        if not self.views:
            return ("show the target, sharp and still",)
        at = np.array(self.views)
        tilts = np.degrees(at[:, 2:4])
        out = [
            f"tilt the target {side}"
            for side, (axis, sign) in _SIDES.items()
            if not (sign * tilts[:, axis] > _TILT_DEG).any()
        ]
        if at[:, 4].max() < _FARTHER * at[:, 4].min():
            out.append(f"nearer or farther (all are {at[:, 4].min():.2f} to {at[:, 4].max():.2f} m away)")
        empty = np.argwhere(~self._seen)
        out += [f"the target into the {_PARTS[row][column]} part of the image" for row, column in empty]
        return tuple(out)

    def _where(self, view: BoardView) -> Array:
        table = CornerTable.of([view], self._target)
        T = board_poses(table, self._lens, np.zeros(SHAPE)).T[0, 0]
        centre = se3.apply(T, self._target.points.mean(axis=0))
        normal = T[:3, 2] * np.sign(T[:3, 2] @ centre)
        sight = centre / np.linalg.norm(centre)
        turn = np.cross(sight, normal)  # from square on to how it stands
        angle = float(np.arctan2(np.linalg.norm(turn), normal @ sight))
        tilt = turn[:2] / max(float(np.linalg.norm(turn)), 1e-9) * angle
        return np.r_[view.pixels.mean(axis=0), tilt, np.linalg.norm(centre)]

    def _differs(self, one: Array, other: Array) -> bool:
        moved = float(np.linalg.norm(one[:2] - other[:2])) > _OTHER_PX
        tilted = float(np.degrees(np.linalg.norm(one[2:4] - other[2:4]))) > _OTHER_DEG
        return moved or tilted or abs(one[4] / other[4] - 1.0) > _OTHER_SHARE


def _motion(one: BoardView, two: BoardView) -> float:
    """Median motion of the corners that both show [px]; infinite where they share none."""
    _, a, b = np.intersect1d(one.ids, two.ids, return_indices=True)
    return float(np.median(np.linalg.norm(one.pixels[a] - two.pixels[b], axis=1))) if len(a) else np.inf

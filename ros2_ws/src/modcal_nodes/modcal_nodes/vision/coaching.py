"""What a person who moves arm or target should do next, from the images so far: hold still, sharper, tilt, nearer.

A view counts where nothing moves and it differs from those that count already. What is missing is judged as a
calibration will judge it: tilts to all four sides, near and far, every part of the image.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from modcal_core.camera import (
    MIN_VIEWS,
    SHAPE,
    BoardView,
    CornerTable,
    Lens,
    PrintedTarget,
    ViewSpread,
    board_poses,
    first_lens,
    fit_lens,
)
from modcal_core.errors import ModcalError
from modcal_core.geometry import Array, se3
from modcal_core.measurements import Recording, spread_rows
from modcal_msgs_py import chosen_topic, stamps_of
from modcal_nodes.vision.bag import JointLog, boards, chosen_stamps, found_targets

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
        self._lens = lens or Lens.plain(_USUAL_FOCAL * size[0], size)
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


_LOOKED_AT = 40  # images, which tell coverage and tilt as well as all of them
_ENOUGH = 15  # images that a calibration wants


@dataclass(frozen=True)
class ImagesWorth:
    """topic, count: of the images. looked_at: of these, found: with the target. size: [px]. edges_px: median width of
    edges. covered: share of the image that holds a corner of some image. tilt_deg, distance_m: least and largest; None
    where the lens could not be told. reasons: of those without the target. findings: sentences, what to do in each.
    """

    topic: str
    count: int
    looked_at: int
    found: int
    size: tuple[int, int] | None
    edges_px: float | None
    covered: float | None
    tilt_deg: tuple[float, float] | None
    distance_m: tuple[float, float] | None
    reasons: dict[str, int]
    findings: tuple[str, ...]


def images_worth(
    bag: Path, recording: Recording, target: PrintedTarget, asked: str | None = None, names: Sequence[str] = ()
) -> ImagesWorth:
    """What the images of a bag are good for. names: of the robot's joints; without them images are spread evenly.

    Raises BadRecording for a bag without images.
    """
    topic = chosen_topic(recording.listed, asked, recording.source)
    stamps = wanted = stamps_of(bag, topic.topic)
    if names:
        with suppress(ModcalError):
            wanted, _ = chosen_stamps(stamps, JointLog.of(recording, names))
    wanted = wanted[spread_rows(len(wanted), _LOOKED_AT)]
    targets = found_targets(boards(bag, topic, target), wanted)
    views, reasons = targets.views, Counter(targets.left_out.values())
    size = targets.sizes[-1] if views else None
    looked_at = len(wanted)
    findings = [f"{n} of {looked_at} images: {why}." for why, n in sorted(reasons.items(), key=lambda r: -r[1])]
    if len(stamps) and not looked_at:
        findings.append("No image has joint states around it: record both on one clock.")
    if len(views) < _ENOUGH:
        findings.append(f"{len(views)} images at different postures show the target: take 25 to 30.")
    edges, spread = None, None
    if views:
        edges = float(np.median([v.sharpness for v in views]))
        if edges > _SOFT_PX:
            findings.append(f"Edges are {edges:.1f} px wide: focus, stand still, or add light.")
    if len(views) >= MIN_VIEWS and size is not None:
        table = CornerTable.of(views, target)
        try:
            lens = fit_lens(table, first_lens(table, size)).lens
        except ModcalError as error:
            findings.append(f"The lens cannot be told: {error}.")
        else:
            seen = board_poses(table, lens, np.zeros(SHAPE)).T[:, 0]
            spread = ViewSpread.of(table, size, seen, target.points.mean(axis=0))
            findings += spread.sentences()
    return ImagesWorth(
        *(topic.topic, len(stamps), looked_at, len(views), size, edges),
        covered=None if spread is None else spread.covered,
        tilt_deg=None if spread is None else (float(np.degrees(spread.tilt[0])), float(np.degrees(spread.tilt[1]))),
        distance_m=None if spread is None else spread.distance,
        reasons=dict(reasons),
        findings=tuple(findings),
    )


def worth_line(worth: ImagesWorth) -> str:
    """One-line summary."""
    parts = [f"{worth.topic}: {worth.count} images, the target in {worth.found} of {worth.looked_at}"]
    if worth.edges_px is not None:
        parts.append(f"edges {worth.edges_px:.1f} px wide")
    if worth.covered is not None:
        parts.append(f"corners on {100.0 * worth.covered:.0f} % of the image")
    if worth.tilt_deg is not None and worth.distance_m is not None:
        parts.append(f"tilt {worth.tilt_deg[0]:.0f}° to {worth.tilt_deg[1]:.0f}°")
        parts.append(f"{worth.distance_m[0]:.2f} to {worth.distance_m[1]:.2f} m away")
    return ", ".join(parts)

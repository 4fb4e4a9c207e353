"""What the images of a bag are good for: how many show the target, how sharp, from where, and what is missing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.camera.corners import SHAPE, CornerTable
from modcal_core.camera.intrinsics import first_lens, fit_lens
from modcal_core.camera.mounting import MIN_VIEWS
from modcal_core.camera.pnp import board_poses
from modcal_core.camera.target import PrintedTarget
from modcal_core.camera.views import BoardView
from modcal_core.camera.weakness import covered, tilt_and_distance
from modcal_core.errors import ModcalError
from modcal_core.measurements.recording import Recording
from modcal_core.measurements.thinning import spread_rows
from modcal_msgs_py.images import chosen_topic, raw_image, read_messages, stamps_of
from modcal_nodes.vision.bag import JointLog, chosen_stamps
from modcal_nodes.vision.detect import detect
from modcal_nodes.vision.grey import grey_of

_LOOKED_AT = 40  # images, which tell coverage and tilt as well as all of them
_ENOUGH = 15  # images that a calibration wants
_SOFT = 3.0  # px; edges of images in focus and at rest are narrower
_TILT, _FARTHER, _COVERED = 20.0, 1.3, 0.4  # degrees, ratio, share; as a calibration asks for


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

    @property
    def data(self) -> dict[str, Any]:
        """Data for ``--json``."""
        return asdict(self)


def images_worth(
    bag: Path, recording: Recording, target: PrintedTarget, asked: str | None = None, names: Sequence[str] = ()
) -> ImagesWorth:
    """What the images of a bag are good for. names: of the robot's joints; without them images are spread evenly.

    Raises BadRecording for a bag without images.
    """
    topic = chosen_topic(recording.listed, asked, recording.source)
    stamps = stamps_of(bag, topic.topic)
    wanted = stamps
    if names:
        try:
            wanted, _ = chosen_stamps(stamps, JointLog.of(recording, names))
        except ModcalError:
            wanted = stamps
    wanted = wanted[spread_rows(len(wanted), _LOOKED_AT)]
    keep, views, reasons = set(wanted.tolist()), [], Counter[str]()
    size: tuple[int, int] | None = None
    for received, message in read_messages(bag, topic.topic):
        image = raw_image(message, received)
        if image is None or image.stamp not in keep:
            continue
        keep.discard(image.stamp)
        grey, why = grey_of(image)
        if grey is None:
            reasons[why] += 1
            continue
        size = (grey.shape[1], grey.shape[0])
        found = detect(grey, target, f"{image.stamp:.6f}")
        if found.view is None:
            reasons[f"{found.reason}: {found.remedy}"] += 1
        else:
            views.append(found.view)
    return _worth(topic.topic, len(stamps), len(wanted), size, views, dict(reasons), target, bool(len(stamps)))


def _worth(
    topic: str,
    count: int,
    looked_at: int,
    size: tuple[int, int] | None,
    views: list[BoardView],
    reasons: dict[str, int],
    target: PrintedTarget,
    any_images: bool,
) -> ImagesWorth:
    findings = [f"{n} of {looked_at} images: {why}." for why, n in sorted(reasons.items(), key=lambda r: -r[1])]
    if any_images and not looked_at:
        findings.append("No image has joint states around it: record both on one clock.")
    if len(views) < _ENOUGH:
        findings.append(f"{len(views)} images at different postures show the target: take 25 to 30.")
    edges = share = tilts = distances = None
    if views:
        edges = float(np.median([v.sharpness for v in views]))
        if edges > _SOFT:
            findings.append(f"Edges are {edges:.1f} px wide: focus, stand still, or add light.")
    if len(views) >= MIN_VIEWS and size is not None:
        table = CornerTable.of(views, target)
        share = covered(table, size)
        if share < _COVERED:
            findings.append(f"Corners cover {100.0 * share:.0f} % of the image: bring the target into its corners.")
        try:
            lens = fit_lens(table, first_lens(table, size)).lens
        except ModcalError as error:
            findings.append(f"The lens cannot be told: {error}.")
        else:
            seen = board_poses(table, lens, np.zeros(SHAPE)).T[:, 0]
            tilt, away = tilt_and_distance(seen, target.points.mean(axis=0))
            tilts = (float(np.degrees(tilt.min())), float(np.degrees(tilt.max())))
            distances = (float(away.min()), float(away.max()))
            if tilts[1] < _TILT:
                findings.append(f"The target is never tilted by more than {tilts[1]:.0f}°: tilt it by 20° to 45°.")
            if distances[1] < _FARTHER * distances[0]:
                findings.append(
                    f"All images are from {distances[0]:.2f} to {distances[1]:.2f} m: take some from twice as far."
                )
    return ImagesWorth(
        topic, count, looked_at, len(views), size, edges, share, tilts, distances, reasons, tuple(findings)
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

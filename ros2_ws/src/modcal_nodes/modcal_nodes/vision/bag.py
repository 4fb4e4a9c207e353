"""Images of a bag with joint states: which of them to use, where the arm was, and the target in each.

Where the arm stops, one image of each stop is used, from its middle, so that nothing moves any more and clocks do not
matter; where it never does, images are spread over the recording, and their clock is fitted.

``apriltag_msgs/AprilTagDetectionArray`` is no part of ROS's own messages: it is read by the definition that the bag
brings. Of a detection its corners count; its pose has no covariance, and flips.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from modcal_core.camera import (
    CHARUCO,
    CHESSBOARD,
    MARKER_CORNERS,
    TAG,
    BoardView,
    ImageMoments,
    Lens,
    MarkerBundle,
    PrintedTarget,
)
from modcal_core.errors import BadRecording, BadTable
from modcal_core.geometry import Array
from modcal_core.measurements import Approach, Listed, Recording, joints_by_time, spread_rows
from modcal_msgs_py import (
    CLOUD,
    TAGS,
    RawImage,
    chosen_topic,
    corner_topics,
    info_topic,
    lens_data,
    raw_image,
    read_corners,
    read_messages,
    size_of,
    stamp_of,
    stamps_of,
    tag_topics,
)
from modcal_nodes.vision.detection import Detection, detect, implausible, marker_corners
from modcal_nodes.vision.images import FoundTargets, ImageFolder, grey_of_file, in_eight_bits, is_mosaic, lens_from_data

_ENCODINGS: dict[str, tuple[int, int | None]] = {  # bytes a pixel, and how it becomes grey
    **dict.fromkeys(("mono8", "8UC1"), (1, None)),
    **dict.fromkeys(("mono16", "16UC1"), (2, None)),  # a depth image is one too, and shows no target
    "rgb8": (3, cv2.COLOR_RGB2GRAY),
    "rgba8": (4, cv2.COLOR_RGBA2GRAY),
    **dict.fromkeys(("bgr8", "8UC3"), (3, cv2.COLOR_BGR2GRAY)),
    **dict.fromkeys(("bgra8", "8UC4"), (4, cv2.COLOR_BGRA2GRAY)),
    # ROS names the first two pixels of the first two rows of a Bayer pattern, OpenCV the second ones
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2GRAY),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2GRAY),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2GRAY),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2GRAY),
    **dict.fromkeys(("yuv422", "uyvy"), (2, cv2.COLOR_YUV2GRAY_UYVY)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (2, cv2.COLOR_YUV2GRAY_YUY2)),
}


def grey_of(image: RawImage) -> tuple[np.ndarray | None, str]:
    """(grey image (h, w) of 8 bits, what was done to it, or nothing) or (None, why not and what to do)."""
    if image.compressed:
        return _unpacked(image)
    if image.encoding not in _ENCODINGS:
        return None, f"is of encoding {image.encoding[:30]}, which is not read: publish mono8, mono16 or rgb8"
    channels, code = _ENCODINGS[image.encoding]
    if image.step < image.width * channels or len(image.data) < image.step * image.height:
        return None, "has fewer bytes than its size says: record it again"
    rows = image.data[: image.step * image.height].reshape(image.height, image.step)
    pixels = np.ascontiguousarray(rows[:, : image.width * channels])
    if code is not None:
        pixels = pixels.reshape(image.height, image.width, channels) if channels > 1 else pixels
        return np.asarray(cv2.cvtColor(pixels, code)), ""
    grey = pixels.view(">u2" if image.bigendian else "<u2").astype(np.uint16) if channels > 1 else pixels
    if is_mosaic(grey):
        return None, "is a raw Bayer mosaic sent as grey: debayer it, or publish its encoding"
    return in_eight_bits(grey)


def _unpacked(image: RawImage) -> tuple[np.ndarray | None, str]:
    if "compressedDepth" in image.encoding:
        return None, "is a depth image: choose the camera's own topic with --image-topic"
    try:
        found = cv2.imdecode(image.data, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        found = None
    if found is None:
        return None, "cannot be unpacked: record it again"
    return grey_of_file(found, "publish 8 bits")


_MAX = 200  # images that are looked at
_STANDING = 0.01  # rad/s or m/s, below which a joint stands; a millimetre in a tenth of a second at a metre
_SETTLED = 0.15  # s after a stop before images of it are used
_BEFORE = 0.05  # s on either side of an image, over which speeds are taken
_GAP = 0.2  # s between joint states around an image, beyond which they do not say where the arm was
_MIN_STOPS = 4  # below, the arm is taken for one that moves
TAGS_SAID = "Corners are those of a detector of AprilTags; the lens was found from them: its images may be rectified."
_Found = tuple[Detection, tuple[int, int], str]  # what was found, size of the image, a note
_Look = Callable[[str], _Found]  # by the name of the image


def read_bag_images(
    bag: Path,
    recording: Recording,
    names: Sequence[str],
    target: PrintedTarget | MarkerBundle,
    asked: str | None = None,
    progress: Callable[[str, float | None], None] = lambda stage, share: None,
    size: tuple[int, int] | None = None,
) -> ImageFolder:
    """The target in images of a bag, and where the arm's joints were. recording: the same bag's joint states.

    names: of the robot's joints. asked: the topic with the images, with detections of AprilTags, or with corners as
    board_detector publishes them. size: of the images that detections are of, where camera_info does not say [px].
    Raises ModcalError where nothing can be used.
    """
    found_before = (*tag_topics(recording.listed), *corner_topics(bag, recording.listed))
    topic = chosen_topic(recording.listed, asked, recording.source, found_before)
    source = f"{recording.source}: {topic.topic}"
    of_tags = topic.type_name == TAGS
    if of_tags:
        require_tags(target)
        size = size or size_of(bag, recording.listed, topic.topic)
        if size is None:
            raise BadRecording(
                source, "does not say how large the images are", "record camera_info, or give --camera-info"
            )
    log = JointLog.of(recording, names)
    stamps = stamps_of(bag, topic.topic)
    wanted, moving = chosen_stamps(stamps, log)
    if not len(wanted):
        said = f"none of {len(stamps)} images has joint states around it"
        raise BadRecording(source, said, "record both on one clock")
    if of_tags:
        looked_at = _messages(bag, topic, partial(_tags, target, size or (0, 0)))
    elif topic.type_name == CLOUD:
        looked_at = _messages(bag, topic, partial(_corners, target))
    else:
        looked_at = boards(bag, topic, target)
    targets = found_targets(looked_at, wanted, partial(progress, "finding the target"))
    size, _ = targets.of_one_size(source, len(wanted))
    at = np.array([view.stamp for view in targets.views])
    q, velocity = log.at(at)
    moments = ImageMoments(at, log.approach(at), log.effort(at), recording.signals)
    velocity = velocity if moving else np.zeros_like(q)
    # what finds tags mostly looks at images that are rectified already, of which camera_info says something else
    lens, lens_of = (None, "") if of_tags else _lens(bag, recording, topic)
    return ImageFolder(
        *(tuple(targets.views), q, velocity, size, targets.left_out, lens, lens_of, moments),
        notes=tuple(targets.notes),
    )


def found_targets(
    looked_at: Iterator[tuple[float, _Look]], wanted: Array, progress: Callable[[float], None] = lambda _: None
) -> FoundTargets:
    """What images with the wanted stamps show of a target. looked_at: (stamp, what looks for it) of each image."""
    targets, keep = FoundTargets(), set(wanted.tolist())
    for stamp, look in looked_at:
        if stamp not in keep:
            continue
        keep.discard(stamp)
        progress(1.0 - len(keep) / len(wanted))
        name = f"{stamp:.6f}"
        found, size, note = look(name)
        if found.view is not None:
            found = replace(found, view=replace(found.view, stamp=stamp))
        targets.take(found, name, size, note)
    return targets


@dataclass(frozen=True)
class JointLog:
    """Joint states of an arm as one table. stamps: increasing (m,) [s]. q, efforts: (m, n), NaN where unknown."""

    stamps: Array
    q: Array
    efforts: Array

    @classmethod
    def of(cls, recording: Recording, names: Sequence[str]) -> JointLog:
        """Those of these joints in a recording. Raises BadRecording where one was not recorded."""
        stamps, q, efforts = joints_by_time(recording, tuple(names), "effort")
        for name, column in zip(names, q.T, strict=True):
            if np.isnan(column).all():
                raise BadRecording(recording.source, f"holds no joint {name}", "record its joint states, or give --tip")
        stamps, rows = np.unique(stamps, return_index=True)
        rows = rows[np.isfinite(stamps)]
        return cls(stamps[: len(rows)], q[rows], efforts[rows])

    def known(self, at: Array) -> np.ndarray:
        """Whether joint states stand close around these stamps, (k,)."""
        i = np.searchsorted(self.stamps, at)
        inside = (i > 0) & (i < len(self.stamps))
        i = np.clip(i, 1, max(len(self.stamps) - 1, 1))
        return np.asarray(inside & (self.stamps[i] - self.stamps[i - 1] <= _GAP)) if len(self.stamps) > 1 else inside

    def at(self, at: Array) -> tuple[Array, Array]:
        """(positions, velocities) at these stamps, (k, n) each."""
        before, after = (self._sampled(self.q, at + late) for late in (-_BEFORE, _BEFORE))
        return self._sampled(self.q, at), (after - before) / (2.0 * _BEFORE)

    def effort(self, at: Array) -> Array:
        """Efforts at these stamps, (k, n)."""
        return self._sampled(self.efforts, at)

    def _sampled(self, columns: Array, at: Array) -> Array:
        return np.stack([np.interp(at, self.stamps, column) for column in columns.T], axis=1)

    def approach(self, at: Array) -> Array:
        """The direction each joint last moved in at these stamps, (k, n)."""
        memory, out, i = Approach(), np.zeros((len(at), self.q.shape[1])), 0
        for k in np.argsort(at):
            while i < len(self.stamps) and self.stamps[i] <= at[k]:
                memory.update(self.q[i])
                i += 1
            out[k] = memory.direction if len(memory.direction) else 0.0
        return out


def chosen_stamps(stamps: Array, log: JointLog) -> tuple[Array, bool]:
    """(stamps of the images to look at, whether the arm moved at them)."""
    stamps = stamps[log.known(stamps)]
    if not len(stamps):
        return stamps, False
    _, velocity = log.at(stamps)
    _, just_before = log.at(stamps - _SETTLED)
    standing = (np.abs(velocity).max(axis=1) < _STANDING) & (np.abs(just_before).max(axis=1) < _STANDING)
    stops = np.split(np.arange(len(stamps)), np.flatnonzero(np.diff(standing.astype(int))) + 1)
    middle = [part[len(part) // 2] for part in stops if standing[part[0]]]
    moving = len(middle) < _MIN_STOPS
    stamps = stamps if moving else stamps[middle]
    return stamps[spread_rows(len(stamps), _MAX)], moving


def boards(bag: Path, topic: Listed, target: PrintedTarget | MarkerBundle) -> Iterator[tuple[float, _Look]]:
    """(stamp, what looks for the target) of each image."""

    def look(image: RawImage, name: str) -> _Found:
        grey, said = grey_of(image)
        if grey is None:
            reason, _, remedy = said.partition(": ")
            return Detection(None, reason, remedy), (0, 0), ""
        return detect(grey, target, name), (grey.shape[1], grey.shape[0]), said

    for received, message in read_messages(bag, topic.topic):
        image = raw_image(message, received)
        if image is not None:
            yield image.stamp, partial(look, image)


def _messages(bag: Path, topic: Listed, look: Callable[[Any, str], _Found]) -> Iterator[tuple[float, _Look]]:
    """(stamp, what takes the target's corners) of each message of corners, or of detections."""
    for received, message in read_messages(bag, topic.topic):
        yield stamp_of(message, received), partial(look, message)


def _corners(target: PrintedTarget | MarkerBundle, message: Any, name: str) -> _Found:
    if isinstance(target, MarkerBundle):
        raise BadTable(target.label, "is no printed sheet, which these corners are of", "give the images, or tags")
    try:
        view, size = read_corners(message)
    except BadRecording as error:
        return Detection(None, error.limit, error.remedy), (0, 0), ""
    if view.ids.max() >= len(target.points):
        said = f"has corner {int(view.ids.max())}, the target has {len(target.points)}"
        return Detection(None, said, "give the target.yaml that board_detector had"), (0, 0), ""
    strange = implausible(target, view.ids, view.pixels)
    return (strange or Detection(replace(view, name=name))), size, ""


def _tags(target: PrintedTarget | MarkerBundle, size: tuple[int, int], message: Any, name: str) -> _Found:
    return tag_view(message, target, name), size, TAGS_SAID


_SIGMA_PX = 0.2  # of a corner at which two lines meet that were fitted to a tag's edges
_MAX_TAGS = 10_000  # of one image
_MENDED = 1  # bits of a tag that were read wrong: more, and it may be another


def require_tags(target: PrintedTarget | MarkerBundle) -> None:
    """Raises BadTable for a target that has no tags, or whose tags are inside something else's corners."""
    if isinstance(target, MarkerBundle):
        if not any(one.size for one in target.markers):
            raise BadTable(target.label, "has points only, which are not found in images", "give a CSV of corners")
    elif target.kind in (CHARUCO, CHESSBOARD):
        remedy = "give the target.yaml of a tag or an AprilGrid, or record the images"
        raise BadTable(f"target {target.kind}", "is not what detections of tags show", remedy)


def tag_view(message: Any, target: PrintedTarget | MarkerBundle, name: str) -> Detection:
    """The corners of the target's tags in a message of detections."""
    try:
        seen = [one for one in list(message.detections)[:_MAX_TAGS] if int(one.hamming) <= _MENDED]
        families = [str(one.family).lower().removeprefix("tag") for one in seen]
        numbers = np.array([int(one.id) for one in seen], dtype=int)
        quads = np.array([[[float(p.x), float(p.y)] for p in one.corners] for one in seen]).reshape(-1, 4, 2)
    except (AttributeError, TypeError, ValueError, OverflowError):  # the definition is the bag's own
        return Detection(None, "holds no detections as apriltag_msgs defines them", "record its own messages")
    family = target.dictionary.partition("APRILTAG_")[2].lower()
    own = np.array([not one or not family or one == family for one in families], dtype=bool)
    if len(own) and not own.any():
        return Detection(None, f"shows tags of family {min(families)[:20]}, the target has {family}", "check both")
    # of a sheet, from a tag's lower left corner counter-clockwise, as its detector has it
    corners = quads[own] if isinstance(target, MarkerBundle) else quads[own, ::-1]
    found = marker_corners(target, numbers[own], corners, either_way=True)
    if found is None:
        said = "shows no tag of the target, or one twice"
        return Detection(None, said, "check its numbers, and show one target only")
    ids, pixels = found
    if len(ids) == MARKER_CORNERS and isinstance(target, PrintedTarget) and target.kind != TAG:
        return Detection(None, "shows one tag of the grid", "show two or more: they tell which corner is which")
    cov = np.tile(_SIGMA_PX**2 * np.eye(2), (len(ids), 1, 1))
    return implausible(target, ids, pixels) or Detection(BoardView(name, ids, pixels, cov))


def _lens(bag: Path, recording: Recording, topic: Listed) -> tuple[Lens | None, str]:
    """What camera_info says of the lens, and where; None where there is none, or the camera was never calibrated."""
    name = info_topic(recording.listed, topic.topic)
    if name is None:
        return None, ""
    source = f"{recording.source}: {name}"
    for _, message in read_messages(bag, name):
        data = lens_data(message)
        return (None, "") if data is None else (lens_from_data(data, source), source)
    return None, ""

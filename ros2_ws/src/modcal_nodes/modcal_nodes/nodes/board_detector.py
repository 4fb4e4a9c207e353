"""``board_detector``: finds a printed target in a camera's images, and says what to do for a good calibration."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2, PointField
from std_msgs.msg import String

from modcal_core.camera import BoardView, Lens, read_target
from modcal_core.errors import BadTable, ModcalError
from modcal_msgs_py import fill_corners, fill_pose, lens_data, nanoseconds, raw_image
from modcal_nodes import ros
from modcal_nodes.vision import Coach, annotated, board_pose, detect, grey_of, lens_from_data


class BoardDetector(ros.HealthyNode):
    """Corners, pose, coaching and an annotated image for each image that it has time for."""

    executable = "board_detector"

    def __init__(self) -> None:
        super().__init__()
        chosen = self._chosen
        if not chosen["target"]:
            raise BadTable("parameter target", "names no file", "set it to the target.yaml of modcal target")
        self._target = read_target(Path(chosen["target"]))
        self._period = 1.0 / chosen["rate_hz"]
        self._last, self._seen, self._found = -np.inf, 0, 0
        self._lens: Lens | None = None
        self._refusal, self._said = "", "no image yet"
        self._coach: Coach | None = None
        self._size = (0, 0)
        self._corners = self.create_publisher(PointCloud2, "~/corners", 10)
        self._pose = self.create_publisher(PoseWithCovarianceStamped, "~/pose", 10)
        self._coaching = self.create_publisher(String, "~/coaching", 10)
        self._annotated = self.create_publisher(Image, "~/annotated", 2)
        self._images = [
            self.hear(Image, "image", self._image, ros.FRESH, single=True),
            self.hear(CompressedImage, "image/compressed", self._image, ros.FRESH, single=True),
        ]
        self._inputs = [*self._images, self.hear(CameraInfo, "camera_info", self._info, ros.FRESH)]

    def _info(self, message: CameraInfo) -> None:
        """What the camera says of its lens; without it no pose is published, and coaching guesses."""
        if self._lens is not None or self._refusal:
            return
        try:
            data = lens_data(message)
            self._lens = None if data is None else lens_from_data(data, "camera_info")
        except ModcalError as error:
            self._refusal = str(error)
            self.get_logger().warning(f"camera_info is not used: {error}")
        self._coach = None

    def _image(self, message: Any) -> None:
        now = time.monotonic()
        if now - self._last < self._period:
            return
        self._last = now
        image = raw_image(message, 1e-9 * self.get_clock().now().nanoseconds)
        self._seen += 1
        if image is None:
            self._say("the image has no size", None, None, message)
            return
        grey, why = grey_of(image)
        if grey is None:
            self._say(f"the image {why}", None, None, message)
            return
        found = detect(grey, self._target, f"{image.stamp:.6f}")
        size = (grey.shape[1], grey.shape[0])
        lens = self._lens if self._lens is not None and self._lens.size == size else None
        if self._coach is None or size != self._size:
            self._coach, self._size = Coach(self._target, size, lens), size
        view = found.view
        if view is not None:
            view = BoardView(view.name, view.ids, view.pixels, view.cov, view.sharpness, image.stamp)
            self._found += 1
            corners = fill_corners(PointCloud2(), PointField, view, size, image.frame)
            if nanoseconds(message.header.stamp):
                corners.header.stamp = message.header.stamp
            self._corners.publish(corners)
            if lens is not None:
                self._publish_pose(view, lens, message)
        said = self._coach.image(view, f"{found.reason}: {found.remedy}")
        if self._lens is not None and lens is None:
            said += f"; camera_info is of {self._lens.size[0]} × {self._lens.size[1]} images and is not used"
        self._say(said, grey, view, message)

    def _publish_pose(self, view: BoardView, lens: Lens, message: Any) -> None:
        T, cov = board_pose(view, self._target, lens)
        out = PoseWithCovarianceStamped(header=message.header)
        fill_pose(out.pose, T, cov)
        self._pose.publish(out)

    def _say(self, said: str, grey: np.ndarray | None, view: BoardView | None, message: Any) -> None:
        self._said = said
        self._coaching.publish(String(data=said))
        if grey is None or not self._annotated.get_subscription_count():
            return
        picture = annotated(grey, view, said)
        out = Image(header=message.header, height=picture.shape[0], width=picture.shape[1], encoding="bgr8")
        out.step = 3 * picture.shape[1]
        out.data = picture.tobytes()
        self._annotated.publish(out)

    def _report(self) -> list[ros.Status]:
        heard = ros.subscription_status(self._inputs, self._refusals)
        facts = {"images": self._seen, "with the target": self._found}
        if not any(subscription.count for subscription in self._images):
            topics = " and ".join(subscription.topic for subscription in self._images)
            return [heard, ros.Status("target", ros.ERROR, f"no image on {topics}: start the camera, or remap", facts)]
        level = ros.OK if self._said.split(" ")[0].isdigit() else ros.WARN
        if self._refusal:
            return [heard, ros.Status("target", ros.WARN, f"{self._said}; camera_info: {self._refusal}", facts)]
        return [heard, ros.Status("target", level, self._said, facts)]

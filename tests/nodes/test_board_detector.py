"""The board_detector node: images in over DDS, corners, pose, coaching and an annotated image out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from camera.boards import BOARD, facing, seen
from camera.render import render
from camera.test_images_verb import VGA
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from nodes.processes import Process, Wait, fresh_domain, listener, running
from nodes.talking import Diagnostics
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from std_msgs.msg import String

from modcal_core.geometry.so3 import Array
from modcal_msgs_py.images import read_corners
from modcal_nodes.cli.main import run

pytestmark = pytest.mark.dds
T = facing(np.random.default_rng(1), 1, tilt=0.5, near=0.33, far=0.4)[0]


class Rig:
    """A camera, and what the node says of its images."""

    def __init__(self, node: Node, wait: Wait) -> None:
        self.node, self.wait = node, wait
        self.images = node.create_publisher(Image, "image", 10)
        self.packed = node.create_publisher(CompressedImage, "image/compressed", 10)
        self.info = node.create_publisher(CameraInfo, "camera_info", 10)
        self.heard: dict[str, list[Any]] = {"corners": [], "pose": [], "coaching": [], "annotated": []}
        kinds = {
            "corners": PointCloud2, "pose": PoseWithCovarianceStamped, "coaching": String, "annotated": Image,
        }  # fmt: skip
        for name, kind in kinds.items():
            node.create_subscription(kind, f"board_detector/{name}", self.heard[name].append, 10)
        self.health = Diagnostics(node)
        self.stamp = 100

    def image(self, pixels: np.ndarray, encoding: str = "mono8") -> Image:
        self.stamp += 1
        message = Image(height=pixels.shape[0], width=pixels.shape[1], encoding=encoding, step=pixels.strides[0])
        message.header.frame_id, message.header.stamp.sec = "camera", self.stamp
        message.data = pixels.tobytes()
        return message

    def until(self, condition: Callable[[], Any], publisher: Any, make: Callable[[], Any]) -> Any:
        """Publish again and again until something is true."""
        timer = self.node.create_timer(0.2, lambda: publisher.publish(make()))
        try:
            return self.wait(condition, 60.0)
        finally:
            self.node.destroy_timer(timer)


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    return render(T, VGA, BOARD, np.random.default_rng(0))


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    domain = fresh_domain()
    made = ["target", "--charuco", "7x5", "--square", "30mm", "--marker", "22mm", "--out", str(tmp_path / "t")]
    assert run(made) == 0
    process = Process("board_detector", domain, tmp_path, target=tmp_path / "t" / "target.yaml", rate_hz=20.0)
    with running(process), listener(domain) as (node, wait):
        yield Rig(node, wait)
        assert process.stop() == 0


def level(rig: Rig, status: str) -> bytes | None:
    said = rig.health.last.get(status)
    return None if said is None else said.level


def last(rig: Rig, words: str) -> Callable[[], Any]:
    return lambda: next((m.data for m in reversed(rig.heard["coaching"]) if words in m.data), None)


def test_images_to_corners_pose_and_words(rig: Rig, picture: np.ndarray) -> None:
    """One node for all of it: each start is a second."""
    # nothing yet: said, and what to do
    status = "/board_detector: target"
    rig.wait(lambda: level(rig, status) == DiagnosticStatus.ERROR, 60.0)
    # an image, held still
    rig.until(last(rig, "next: tilt the target"), rig.images, lambda: rig.image(picture))
    view, size = read_corners(rig.heard["corners"][-1])
    assert size == (640, 480)
    assert rig.heard["corners"][-1].header.frame_id == "camera"
    expected: Array = seen(T, BOARD.points[view.ids], VGA)
    assert np.sqrt(((view.pixels - expected) ** 2).mean()) < 0.1
    assert not rig.heard["pose"]  # nobody has said what the lens is
    rig.wait(lambda: level(rig, status) == DiagnosticStatus.OK, 60.0)
    drawn = rig.wait(lambda: rig.heard["annotated"] and rig.heard["annotated"][-1], 60.0)
    assert (drawn.width, drawn.height, drawn.encoding) == (640, 480, "bgr8")
    # compressed images, and a lens
    info = CameraInfo(width=640, height=480, distortion_model="plumb_bob", k=VGA.K.ravel().tolist())
    info.d = [float(x) for x in VGA.values[4:]]
    rig.info.publish(info)
    png = cv2.imencode(".png", picture)[1].tobytes()

    def packed() -> CompressedImage:
        rig.info.publish(info)
        rig.stamp += 1
        message = CompressedImage(format="png", data=png)
        message.header.stamp.sec = rig.stamp
        return message

    pose = rig.until(lambda: rig.heard["pose"] and rig.heard["pose"][-1], rig.packed, packed)
    p = pose.pose.pose.position
    assert np.array([p.x, p.y, p.z]) == pytest.approx(T[:3, 3], abs=2e-3)
    cov = np.array(pose.pose.covariance).reshape(6, 6)
    assert 1e-5 < np.sqrt(cov[2, 2]) < 1e-3
    # what cannot be used is said in words
    rig.until(last(rig, "mirrored"), rig.images, lambda: rig.image(np.ascontiguousarray(picture[:, ::-1])))
    rig.until(last(rig, "32FC1"), rig.images, lambda: rig.image(picture.astype(np.float32), "32FC1"))
    rig.wait(lambda: level(rig, status) == DiagnosticStatus.WARN, 60.0)

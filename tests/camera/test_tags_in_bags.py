"""Detections of AprilTags in a bag: read by the definition that the bag brings, in whichever order corners come."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera.bags import JOINT_STATE, START, header, stops
from camera.boards import views
from camera.scenes import PANDA, CameraScene, scene
from camera.test_image_bags import camera_info
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from modcal_core.camera.bundle import APRIL_GRID, TAG, BoardView, PrintedTarget
from modcal_core.camera.target_file import target_to_data
from modcal_core.errors import ModcalError
from modcal_core.files import to_yaml
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.robot import Robot
from modcal_msgs_py.images import CAMERA_INFO, TAGS
from modcal_msgs_py.layout import definition, message_class
from modcal_msgs_py.mcap_read import read_recording
from modcal_nodes.cli.main import run
from modcal_nodes.vision.bag import TAGS_SAID, read_bag_images
from modcal_nodes.vision.images import ImageFolder

GRID = PrintedTarget(APRIL_GRID, 4, 3, 0.04, 0.012, "DICT_APRILTAG_36h11", first_id=5)
POINT, ONE = "apriltag_msgs/msg/Point", "apriltag_msgs/msg/AprilTagDetection"
FIELDS = {
    POINT: "float64 x\nfloat64 y\n",
    ONE: """string family
int32 id
int32 hamming
float32 goodness
float32 decision_margin
apriltag_msgs/Point centre
apriltag_msgs/Point[4] corners
float64[9] homography
""",
    TAGS: "std_msgs/Header header\napriltag_msgs/AprilTagDetection[] detections\n",
}
TEXT = (
    FIELDS[TAGS]
    + "".join(f"{'=' * 80}\nMSG: {name.replace('/msg/', '/')}\n{FIELDS[name]}" for name in (ONE, POINT))
    + f"{'=' * 80}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    + f"{'=' * 80}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)


def bag_of_tags(
    path: Path,
    s: CameraScene,
    turned: int = 0,
    family: str = "36h11",
    info: bool = True,
    second: Sequence[BoardView] = (),
) -> Path:
    """A bag of an arm that stops at each posture. turned: by how many corners the detector begins elsewhere. second:
    what another camera shows.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in FIELDS.items():
        store.register(get_types_from_msg(text, name))

    def corner(p: Array) -> Any:
        return store.types[POINT](x=float(p[0]), y=float(p[1]))

    def detection(number: int, quad: Array) -> Any:
        corners = [corner(p) for p in np.roll(quad, turned, axis=0)]
        return store.types[ONE](
            family, number + GRID.first_id, 0, 0.0, 60.0, corner(quad.mean(0)), corners, np.eye(3).ravel()
        )

    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        channels: dict[str, int] = {}

        def write(topic: str, type_name: str, message: Any, t: float) -> None:
            if topic not in channels:
                text = TEXT if type_name == TAGS else definition(type_name)[0]
                channels[topic] = writer.register_channel(
                    topic, "cdr", writer.register_schema(type_name, "ros2msg", text.encode())
                )
            writer.add_message(
                channels[topic], round(t * 1e9), bytes(store.serialize_cdr(message, type_name)), round(t * 1e9)
            )

        String = message_class("std_msgs/msg/String")
        write("/robot_description", "std_msgs/msg/String", String(data=PANDA.read_text()), START)
        if info:
            write(
                "/camera/camera_info", CAMERA_INFO, camera_info(START, s.lens.size, s.lens.K, s.lens.values[4:]), START
            )
        for t, state, k, share in stops(s.chain.names, s.q):
            write("/joint_states", JOINT_STATE, state, t)
            shown = {"/detections": s.views, **({"/second/detections": second} if second else {})}
            for topic, seen in shown.items() if share == 0.5 else ():
                one = seen[k]
                by_tag = [(n, one.pixels[one.ids // 4 == n]) for n in np.unique(one.ids // 4)]
                found = [detection(int(n), quad) for n, quad in by_tag if len(quad) == 4]
                write(topic, TAGS, store.types[TAGS](header(t, "camera"), found), t)
        writer.finish()
    return path


@pytest.fixture(scope="module")
def cell() -> CameraScene:
    return scene(12, True, count=6, board=GRID)


def read(path: Path, target: PrintedTarget, **options: Any) -> ImageFolder:
    recording = read_recording(path)
    robot = Robot.from_urdf(PANDA, tip="panda_link8")
    return read_bag_images(path, recording, robot.names, target, **options)


@pytest.mark.parametrize("turned", [0, 3])
def test_corners_of_tags_are_those_of_the_target(cell: CameraScene, turned: int, tmp_path: Path) -> None:
    """Numbers, pixels, joints and size of the images, without a package of these messages."""
    found = read(bag_of_tags(tmp_path / "tags.mcap", cell, turned), GRID)
    assert found.size == cell.lens.size
    assert found.lens is None
    assert found.notes == (TAGS_SAID,)
    assert len(found.views) == len(cell.views)
    for view, expected, q, true in zip(found.views, cell.views, found.q, cell.q, strict=True):
        whole = np.isin(expected.ids // 4, np.unique(view.ids // 4))
        assert (view.ids == expected.ids[whole]).all()
        assert view.pixels == pytest.approx(expected.pixels[whole])
        assert q == pytest.approx(true)


def test_tags_that_do_not_serve_are_refused(cell: CameraScene, tmp_path: Path) -> None:
    other = bag_of_tags(tmp_path / "other.mcap", cell, family="tag25h9")
    silent = bag_of_tags(tmp_path / "silent.mcap", cell, info=False)
    few = PrintedTarget(TAG, 1, 1, 0.1, dictionary="DICT_APRILTAG_36h11", first_id=3)
    board = PrintedTarget("charuco", 7, 5, 0.03, 0.022, "DICT_5X5_100")
    for path, target, words in (
        (other, GRID, "family 25h9"),
        (silent, GRID, "how large the images are"),
        (silent, board, "not what detections of tags show"),
        (other, few, "none of"),
    ):
        with pytest.raises(ModcalError, match=words):
            read(path, target)
    assert read(silent, GRID, size=cell.lens.size).size == cell.lens.size


@pytest.mark.slow
def test_two_cameras_on_one_hand_by_the_verb(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Both see the same grid of tags; the second is named with its topic, and has a lens file of its own."""
    s = scene(12, True, count=12, board=GRID)
    aside = se3.exp([0.03, 0.01, 0.0, 0.0, 0.05, 0.0])
    second = views(np.random.default_rng(1), se3.inverse(aside) @ se3.inverse(s.T), board=GRID)
    bag = bag_of_tags(tmp_path / "tags.mcap", s, second=second)
    (tmp_path / "grid.yaml").write_text(to_yaml(target_to_data(GRID)))
    call = ["calibrate", str(bag), "--target", str(tmp_path / "grid.yaml"), "--tip", "panda_link8", "--geometry-only"]
    call += ["--image-topic", "/detections", "--also-camera", "/second/detections", "--out", str(tmp_path / "out")]
    assert run(call) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    (further,) = report["camera"]["further"]
    assert (further["name"], further["mounting"]) == ("/second/detections", "tip")
    assert further["images"]["used"] >= 10
    assert further["lens"]["fx"]["value"] == pytest.approx(s.lens.values[0], rel=0.01)
    assert TAGS_SAID in report["notes"]
    assert "camera_matrix" in (tmp_path / "out" / "camera_2.yaml").read_text()
    assert "Also /second/detections, on the tip: " in capsys.readouterr().out
    assert run([*call[:-2], "--also-camera", "/second/detections=nowhere.yaml"]) == 2
    assert "names no file" in capsys.readouterr().err

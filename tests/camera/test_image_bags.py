"""Bags with images or detections of AprilTags: the same result as from a folder, and every kind of image."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from camera.bags import JOINT_STATE, START, header, stops
from camera.boards import BOARD, seen, views
from camera.render import render
from camera.scenes import PANDA, CameraScene, scene
from camera.test_camera_fit import BALL, TRACKER
from camera.test_images_verb import VGA
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from modcal_core.camera.bundle import APRIL_GRID, TAG, BoardView, PrintedTarget
from modcal_core.camera.target_file import target_to_data
from modcal_core.errors import ModcalError
from modcal_core.files import to_yaml
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import Listed
from modcal_core.robot import Robot
from modcal_msgs_py.images import CAMERA_INFO, COMPRESSED, IMAGE, TAGS, RawImage, chosen_topic
from modcal_msgs_py.layout import definition, message_class
from modcal_msgs_py.mcap_read import read_recording
from modcal_msgs_py.mcap_write import BagWriter
from modcal_nodes.cli.main import run
from modcal_nodes.vision.bag import TAGS_SAID, JointLog, chosen_stamps, grey_of, read_bag_images
from modcal_nodes.vision.images import SCALED, ImageFolder


@dataclass(frozen=True)
class Recorded:
    """A bag, and the scene that it shows."""

    bag: Path
    scene: CameraScene
    pictures: list[np.ndarray]


def camera_info(stamp: float, size: tuple[int, int], K: Array, d: Array) -> Any:
    roi = message_class("sensor_msgs/msg/RegionOfInterest")(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return message_class(CAMERA_INFO)(
        header=header(stamp, "camera"),
        height=size[1],
        width=size[0],
        distortion_model="plumb_bob",
        d=np.asarray(d, dtype=float),
        k=np.asarray(K, dtype=float).ravel(),
        r=np.eye(3).ravel(),
        p=np.c_[K, np.zeros(3)].ravel(),
        binning_x=0,
        binning_y=0,
        roi=roi,
    )


def write_cell(folder: Path, s: CameraScene, pictures: Sequence[np.ndarray], lens_of: tuple[int, int] | None) -> Path:
    """A bag of an arm that stops at each posture, one image and one reading of a ball at every stop."""
    point, at_point = (message_class(f"geometry_msgs/msg/{name}") for name in ("PointStamped", "Point"))
    out: list[tuple[float, str, str, Any]] = []
    rng = np.random.default_rng(2)
    ball = se3.apply(TRACKER @ s.T, BALL) + 5e-5 * rng.standard_normal((len(s.q), 3))
    for t, state, k, share in stops(s.chain.names, s.q):
        out.append((t, "/joint_states", JOINT_STATE, state))
        if share == 0.5:
            packed = cv2.imencode(".png", pictures[k])[1].ravel()
            image = message_class(COMPRESSED)(header=header(t, "camera"), format="png", data=packed)
            out.append((t, "/camera/image_raw/compressed", COMPRESSED, image))
        if 0.2 <= share < 0.8:
            said = at_point(*(float(x) for x in ball[k] + 2e-5 * rng.standard_normal(3)))
            out.append((t, "/tracker/point", "geometry_msgs/msg/PointStamped", point(header(t, "tracker"), said)))
    with BagWriter(folder) as bag:
        String = message_class("std_msgs/msg/String")
        bag.write("/robot_description", "std_msgs/msg/String", String(data=PANDA.read_text()), int(1e9 * START))
        if lens_of is not None:
            info = camera_info(START, lens_of, VGA.K, VGA.values[4:])
            bag.write("/camera/camera_info", CAMERA_INFO, info, int(1e9 * START))
        for stamp, topic, type_name, message in out:
            bag.write(topic, type_name, message, int(1e9 * stamp))
    return folder


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """Ten stops of an arm with a camera on its tip, rendered once."""
    s = scene(11, True, count=10, lens=VGA)
    rng = np.random.default_rng(0)
    pictures = [render(T, VGA, BOARD, rng, rays=4) for T in se3.inverse(s.T)]  # with two, edges wander by 0.1 px
    where = tmp_path_factory.mktemp("bags")
    bag = write_cell(where / "cell", s, pictures, None)
    assert run(["target", "--charuco", "7x5", "--square", "30mm", "--marker", "22mm", "--out", str(where / "t")]) == 0
    return Recorded(bag, s, pictures)


def target(recorded: Recorded) -> str:
    return str(recorded.bag.parent / "t" / "target.yaml")


@pytest.mark.slow
def test_images_and_a_tracker_in_one_bag(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An unmeasured sheet and a few tracker points in the same bag: apply, to what is stated."""
    call = ["calibrate", str(recorded.bag), "--target", target(recorded), "--tip", "panda_link8"]
    assert run([*call, "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["camera"]["images"]["used"] == len(recorded.scene.q)
    assert report["camera"]["metric"] == ["readings of point in tracker"]
    assert report["camera"]["decision"] == "apply", said
    assert report["camera"]["tool_error_mm"]["in_view"]["calibrated"]["high95"] < 5.0


@pytest.mark.slow
def test_one_image_of_each_stop(recorded: Recorded) -> None:
    recording = read_recording(recorded.bag)
    log = JointLog.of(recording, recorded.scene.chain.names)
    every = np.arange(START, START + 19.0, 0.04)
    wanted, moving = chosen_stamps(every, log)
    assert not moving
    assert len(wanted) == 10
    q, velocity = log.at(wanted)
    assert np.abs(q - recorded.scene.q).max() < 1e-9
    assert np.abs(velocity).max() < 1e-9
    came = log.approach(wanted)
    assert (came[1:] == np.sign(np.diff(recorded.scene.q, axis=0))).mean() > 0.95
    # an arm that never stops
    going = replace(log, q=log.q + 0.2 * np.sin(log.stamps)[:, None])
    assert chosen_stamps(every, going)[1]
    assert len(chosen_stamps(np.arange(0.0, 10.0, 0.1), log)[0]) == 0


def image_of(pixels: np.ndarray, encoding: str, step: int | None = None) -> RawImage:
    data = np.ascontiguousarray(pixels).view(np.uint8).ravel()
    return RawImage(0.0, encoding, pixels.shape[1], pixels.shape[0], step or pixels.strides[0], False, data)


def mosaic(colour: np.ndarray, order: str) -> np.ndarray:
    """The colour filter's pattern over an image with channels r, g, b."""
    out = np.empty(colour.shape[:2], np.uint8)
    for i, c in enumerate(order):
        y, x = divmod(i, 2)
        out[y::2, x::2] = colour[y::2, x::2, "rgb".index(c)]
    return out


@pytest.mark.parametrize("order", ["rggb", "bggr", "gbrg", "grbg"])
def test_every_order_of_bayer_is_the_same_picture(order: str) -> None:
    y, x = np.mgrid[0:60, 0:80]
    colour = np.stack([60.0 + x, 90.0 + y, 200.0 - x], axis=2).astype(np.uint8)
    grey, why = grey_of(image_of(mosaic(colour, order), f"bayer_{order}8"))
    assert grey is not None, why
    expected = cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY).astype(int)
    assert np.abs(grey.astype(int) - expected)[4:-4, 4:-4].max() <= 3


def test_encodings() -> None:
    colour = np.random.default_rng(0).integers(0, 255, (12, 16, 3)).astype(np.uint8)
    one, two = grey_of(image_of(colour, "rgb8"))[0], grey_of(image_of(colour[:, :, ::-1].copy(), "bgr8"))[0]
    assert one is not None
    assert two is not None
    assert (one == two).all()
    flat = np.full((12, 20), 90, np.uint8)
    padded = grey_of(replace(image_of(flat, "mono8"), width=16))[0]
    assert padded.shape == (12, 16)
    refused = {
        "rgb16": image_of(np.zeros((4, 4, 3), np.uint16), "rgb16"),
        "which is not read": image_of(flat, "jpeg2000"),
        "fewer bytes": replace(image_of(flat, "mono8"), height=40),
        "Bayer": image_of(mosaic(np.dstack([flat, flat // 2, flat // 3]), "rggb"), "mono8"),
        "unpacked": replace(image_of(flat, "jpeg"), compressed=True),
        "depth": replace(image_of(flat, "16UC1; compressedDepth"), compressed=True),
    }
    for words, image in refused.items():
        grey, why = grey_of(image)
        assert grey is None
        assert words in why
        assert ": " in why


def test_images_of_sixteen_bits_are_scaled_and_it_is_said() -> None:
    """Twelve bits of sixteen, a stuck pixel among them, in either order of bytes, and as a png."""
    grey = np.clip(np.random.default_rng(0).normal(120.0, 30.0, (60, 80)), 0, 255).astype(np.uint8)
    deep = 100 + 9 * grey.astype(np.uint16)
    deep[3, 4] = 65535
    for image in (
        image_of(deep, "mono16"),
        replace(image_of(deep.byteswap(), "16UC1"), bigendian=True),
        replace(image_of(cv2.imencode(".png", deep)[1].reshape(1, -1), "png"), compressed=True),
    ):
        read, said = grey_of(image)
        assert said == SCALED
        assert np.corrcoef(np.delete(read.ravel(), 244), np.delete(grey.ravel(), 244))[0, 1] > 0.999
        assert read.std() > grey.std()


def test_which_topic() -> None:
    raw_, packed = Listed("/c/image", IMAGE, 5), Listed("/c/image/compressed", COMPRESSED, 5)
    other, depth = Listed("/d/image", IMAGE, 5), Listed("/depth/image", IMAGE, 5)
    assert chosen_topic((packed, raw_, depth), None, "bag") == raw_
    assert chosen_topic((raw_, other), "d/image", "bag") == other
    for listed, words in ((((raw_, other)), "choose one"), (((depth,)), "holds no images")):
        with pytest.raises(ModcalError, match=words):
            chosen_topic(listed, None, "bag")


@pytest.mark.slow
def test_info_says_what_images_are_good_for(recorded: Recorded, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["info", str(recorded.bag), "--tip", "panda_link8"]) == 0
    assert "a calibration by camera (10 of /camera/image_raw/compressed)" in " ".join(capsys.readouterr().out.split())
    call = ["info", str(recorded.bag), "--tip", "panda_link8", "--target", target(recorded), "--json"]
    assert run(call) == 0
    images = json.loads(capsys.readouterr().out)["images"]
    assert images["found"] == images["looked_at"] == 10
    assert 1.0 < images["edges_px"] < 3.0
    low, high = images["tilt_deg"]
    assert 0.0 <= low < 20.0 < high < 60.0
    assert images["distance_m"][0] == pytest.approx(0.35, abs=0.1)
    assert any("take 25 to 30" in said for said in images["findings"])


@pytest.mark.slow
def test_plan_says_which_images_to_take_next(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Postures that show the whole target, and by which the expected error falls, as MuJoCo's arm sees it."""
    call = ["plan", "--camera", str(recorded.bag), "--target", target(recorded), "--tip", "panda_link8"]
    assert run([*call, "--stations", "5", "--out", str(tmp_path / "plan"), "--json"]) == 0
    plan = json.loads(capsys.readouterr().out)
    expected = np.array(plan["expected_mm"])
    assert (np.diff(expected) < 0.0).all()
    assert expected[-1] < 0.85 * expected[0]
    q = np.loadtxt(tmp_path / "plan" / "stations.csv", delimiter=",", skiprows=1)
    assert q == pytest.approx(np.array(plan["stations"]))
    for T in se3.inverse(recorded.scene.truth(q)):
        pixels = seen(T, BOARD.points, VGA)
        assert ((pixels > 0.0) & (pixels < np.array(VGA.size))).all()
    assert run(["plan", "--target", target(recorded)]) == 2
    assert "needs --camera and --target" in capsys.readouterr().err


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

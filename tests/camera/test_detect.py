"""Finding the target: rendered boards, what an image is worth, and one clear line where it cannot be used."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera.boards import BOARD, facing, seen
from camera.render import render

from modcal_core.camera.bundle import APRIL_GRID, ARUCO_GRID, CHESSBOARD, PrintedTarget
from modcal_core.camera.lens import Lens
from modcal_core.errors import ModcalError
from modcal_core.files import to_yaml
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_nodes.vision.detection import detect
from modcal_nodes.vision.images import SCALED, read_camera_info, read_images, require_size
from modcal_nodes.vision.saddle import fit_board
from modcal_nodes.vision.sheet import draw_sheet, rectangles

SMALL = Lens(np.array([520.0, 522.0, 322.0, 238.0, -0.1, 0.05, 5e-4, -3e-4, 0.0]), (640, 480))


def poses(count: int = 1, seed: int = 1) -> Array:
    return facing(np.random.default_rng(seed), count, tilt=0.5, near=0.33, far=0.4)


def image(board: PrintedTarget = BOARD, seed: int = 1, **options: float) -> np.ndarray:
    return render(poses(seed=seed)[0], SMALL, board, np.random.default_rng(seed), **options)


@pytest.mark.slow
@pytest.mark.parametrize("board", [BOARD, PrintedTarget(CHESSBOARD, 7, 4, 0.03)], ids=["charuco", "chessboard"])
def test_corners_are_where_the_renderer_has_them(board: PrintedTarget) -> None:
    """To 0.02 px, and the covariances of the fits say so: standard scores are 1 on average, 200 of them to a tenth."""
    scores, gaps = [], []
    for i, T in enumerate(poses(4)):
        grey = render(T, SMALL, board, np.random.default_rng(i), rays=4)  # with two, edges wander by more than noise
        view = detect(grey, board, "a.png").view
        assert len(view) >= 0.6 * len(board.points)
        gap = view.pixels - seen(T, board.points[view.ids], SMALL)
        gaps.append(gap)
        fit = fit_board(grey, board, view.ids, view.pixels)
        assert fit.good.all()
        assert (np.linalg.eigvalsh(view.cov - fit.cov) > 0.0).all()  # no better than the print is
        scores.append(np.einsum("mi,mij,mj->m", gap, np.linalg.inv(fit.cov), gap))
    assert np.sqrt((np.concatenate(gaps) ** 2).mean()) < 0.02
    assert 0.6 < np.concatenate(scores).mean() / 2.0 < 1.6


def test_what_lies_beside_a_corner_does_not_draw_it() -> None:
    """A marker in the white squares, an eighth of their side from their edges, and edges blurred by motion."""
    grey = render(poses()[0], SMALL, BOARD, np.random.default_rng(3), noise=2.0)
    streak = np.zeros((7, 7))
    streak[3, 1:6] = 0.2
    found = detect(cv2.filter2D(grey, -1, streak), BOARD, "a").view
    gap = found.pixels - seen(poses()[0], BOARD.points[found.ids], SMALL)
    assert np.sqrt((gap**2).mean()) < 0.03
    # across the motion the edges are as sharp as they were
    assert (found.cov[:, 1, 1] < found.cov[:, 0, 0]).mean() > 0.9


def test_a_corner_half_covered_is_said_to_be_rough() -> None:
    grey = render(poses()[0], SMALL, BOARD, np.random.default_rng(3), noise=2.0)
    at = seen(poses()[0], BOARD.points[[9]], SMALL)[0].astype(int)
    grey[at[1] - 1 : at[1] + 30, at[0] - 1 : at[0] + 30] = 128
    found = detect(grey, BOARD, "a").view
    for id_, pixel, cov in zip(found.ids, found.pixels, found.cov, strict=True):
        gap = pixel - seen(poses()[0], BOARD.points[[id_]], SMALL)[0]
        assert np.sqrt(gap @ np.linalg.solve(cov, gap)) < 6.0, id_


def test_grids_of_markers() -> None:
    """A grid's own order is found for OpenCV's markers and for AprilTags that lie another way round."""
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    picture = cv2.aruco.GridBoard((3, 2), 100, 30, words).generateImage((420, 290), marginSize=20)
    grey = cv2.GaussianBlur(cv2.copyMakeBorder(picture, 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255), (0, 0), 0.8)
    opencv = PrintedTarget(ARUCO_GRID, 3, 2, 0.1, 0.03, "DICT_APRILTAG_36h11")
    found = detect(grey, opencv, "a").view
    assert len(found) == 24
    scale = np.linalg.lstsq(np.c_[opencv.points[found.ids, :2], np.ones(24)], found.pixels, rcond=None)[0]
    assert (
        np.abs(np.c_[opencv.points[found.ids, :2], np.ones(24)] @ scale - found.pixels).max() < 2.0
    )  # as OpenCV fits the page
    # Kalibr numbers from the lower left
    upwards = cv2.aruco.GridBoard((3, 2), 100, 30, words, np.array([3, 4, 5, 0, 1, 2])).generateImage(
        (420, 290), marginSize=20
    )
    kalibr = replace(opencv, kind=APRIL_GRID)
    view = detect(cv2.GaussianBlur(upwards, (0, 0), 0.8), kalibr, "a").view
    assert len(view) == 24
    flat = np.c_[kalibr.points[view.ids, :2], np.ones(24)]
    fitted = np.linalg.lstsq(flat, view.pixels, rcond=None)[0]
    assert np.abs(flat @ fitted - view.pixels).max() < 2.0
    assert fitted[1, 1] < 0.0 < fitted[0, 0]  # y goes up


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda g: np.full_like(g, 90), "one grey"),
        (lambda g: np.random.default_rng(0).integers(0, 255, g.shape).astype(np.uint8), "no target"),
        (lambda g: np.ascontiguousarray(g[:, ::-1]), "mirrored"),
        (lambda g: cv2.GaussianBlur(g, (0, 0), 3.5), "blurred|no target|markers"),
    ],
    ids=["grey", "no board", "mirrored", "blurred"],
)
def test_images_that_cannot_be_used(spoil: Callable[[np.ndarray], np.ndarray], said: str) -> None:
    found = detect(spoil(image()), BOARD, "a.png")
    assert found.view is None
    assert re.search(said, found.reason)
    assert found.remedy


@pytest.mark.slow
def test_a_single_row_of_corners_is_too_few() -> None:
    """They lie on one line, which no homography is taken from."""
    T = se3.transform(np.eye(3), [-0.105, -0.075, 0.3])
    grey = render(T, SMALL, BOARD, np.random.default_rng(0))
    # down to just below the second row of squares: six corners
    end = int(seen(T, np.array([[0.0, 0.061, 0.0]]), SMALL)[0, 1])
    found = detect(np.ascontiguousarray(grey[:end]), BOARD, "")
    assert found.view is None
    assert "not on one line" in found.reason


def test_another_board() -> None:
    found = detect(image(), replace(BOARD, dictionary="DICT_4X4_100"), "a")
    assert found.view is None
    assert "DICT_5X5" in found.reason
    small = detect(image(), replace(BOARD, columns=5, rows=7), "a")
    assert small.view is None or len(small.view) < 24


@pytest.mark.slow
@pytest.mark.parametrize("size", [(8, 5), (5, 5)])
def test_a_board_of_other_squares(size: tuple[int, int]) -> None:
    found = detect(image(), replace(BOARD, columns=size[0], rows=size[1]), "a")
    assert found.view is None
    assert "number of squares" in found.remedy


@pytest.mark.parametrize("size", [(8, 5), (5, 4)])
def test_a_chessboard_of_other_squares(size: tuple[int, int]) -> None:
    """Fewer than there are would be found anywhere on the board, elsewhere in the next image."""
    found = detect(image(PrintedTarget(CHESSBOARD, 7, 4, 0.03)), PrintedTarget(CHESSBOARD, *size, 0.03), "a")
    assert found.view is None
    # a part of it may look like a bent board of that size
    assert re.search("count the squares|check the target file", found.remedy)


def test_two_boards() -> None:
    one = image(seed=1)
    two = cv2.resize(np.concatenate([one, one], axis=1), (1280, 480))
    found = detect(two, BOARD, "a")
    assert found.view is None
    assert "two boards" in found.reason or "flat" in found.reason


def folder(tmp_path: Path, pictures: dict[str, np.ndarray], table: str | None = None) -> tuple[Path, Path]:
    (tmp_path / "images").mkdir()
    for name, picture in pictures.items():
        cv2.imwrite(str(tmp_path / "images" / name), picture)
    rows = "".join(f"{name},0.1,0.2\n" for name in pictures)
    joints = tmp_path / "joints.csv"
    joints.write_text(table if table is not None else f"image,a,b\n{rows}")
    return tmp_path / "images", joints


def test_folder_names_what_it_leaves_out(tmp_path: Path) -> None:
    grey = image()
    mosaic = grey.copy()
    mosaic[::2, ::2] = 0.6 * mosaic[::2, ::2]
    pictures = {
        "1.png": grey,
        "2.png": grey.astype(np.uint16) * 200,
        "3.png": mosaic,
        "10.png": grey,
        "11.png": cv2.resize(grey, (1280, 960)),
    }
    where, joints = folder(tmp_path, pictures)
    (where / "12.png").write_bytes(b"not an image")
    (where / "13.png").write_bytes(b"")
    joints.write_text(joints.read_text() + "12.png,0,0\n")
    found = read_images(where, joints, ("a", "b"), BOARD)
    assert [v.name for v in found.views] == ["1.png", "2.png", "10.png"]
    assert np.abs(found.views[1].pixels - found.views[0].pixels).max() < 0.02  # of 16 bits: read, and said
    assert found.notes == (SCALED,)
    assert found.q == pytest.approx(np.array([[0.1, 0.2]] * 3))
    said = {
        "3.png": "Bayer",
        "11.png": "1280 × 960",
        "12.png": "cannot be read",
        "13.png": "joints",
    }
    assert set(found.left_out) == set(said)
    for name, words in said.items():
        assert words in found.left_out[name]
        assert ": " in found.left_out[name]


def test_a_jpeg_is_read_as_the_sensor_had_it(tmp_path: Path) -> None:
    """Whatever way round its Exif says to show it: half of them turned would be two cameras."""
    plain = cv2.imencode(".jpg", image())[1].tobytes()
    for_viewers = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x03\0\0\0\0\0\0\0"  # orientation 3
    turned = plain[:2] + b"\xff\xe1" + (len(for_viewers) + 2).to_bytes(2, "big") + for_viewers + plain[2:]
    assert (cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_GRAYSCALE)[0] != image()[0]).any()
    where, joints = folder(tmp_path, {})
    (where / "1.jpg").write_bytes(plain)
    (where / "2.jpg").write_bytes(turned)
    joints.write_text("image,a,b\n1.jpg,0.1,0.2\n2.jpg,0.1,0.2\n")
    one, other = read_images(where, joints, ("a", "b"), BOARD).views
    assert (one.pixels == other.pixels).all()


def test_images_named_by_their_stamps(tmp_path: Path) -> None:
    table = "stamp,b,a\n" + "".join(f"{t:.2f},{t - 10.0},{20.0 - 2.0 * t}\n" for t in np.arange(10.0, 11.0, 0.05))
    where, joints = folder(tmp_path, {"10.12.png": image(), "30.0.png": image()}, table)
    found = read_images(where, joints, ("a", "b"), BOARD)
    assert found.q[0] == pytest.approx([-0.24, 0.12])
    assert found.velocity[0] == pytest.approx([-2.0, 1.0])
    assert "30.0.png" in found.left_out


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ("image,a\n1.png,0\n", "no column for joint b"),
        ("a,b\n0,0\n", "neither a column image"),
        ("image,a,b\n1.png,x,0\n", "line 2"),
        ("image,a,b\n1.png,90,0\n", "radians"),
        ("image,a,b\n1.png,nan,0\n", "not finite"),
        ("image,a,b\n1.png,0,0\n1.png,0,1\n", "two rows"),
        ("stamp,a,b\n2,0,0\n1,0,0\n", "do not increase"),
    ],
)
def test_bad_tables_are_refused(tmp_path: Path, table: str, said: str) -> None:
    where, joints = folder(tmp_path, {"1.png": np.zeros((48, 64), np.uint8)}, table)
    with pytest.raises(ModcalError, match=said):
        read_images(where, joints, ("a", "b"), BOARD)


def test_camera_info(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    data = {"image_width": 640, "image_height": 480, "distortion_model": "plumb_bob"}
    data |= {"camera_matrix": {"rows": 3, "cols": 3, "data": SMALL.K.ravel().tolist()}}
    data |= {"distortion_coefficients": {"rows": 1, "cols": 5, "data": [float(x) for x in SMALL.values[4:]]}}
    path.write_text(to_yaml(data))
    lens = read_camera_info(path)
    assert np.abs(lens.values - SMALL.values).max() < 1e-12
    require_size(lens, (640, 480), "camera.yaml")
    with pytest.raises(ModcalError, match="this resolution"):
        require_size(lens, (1280, 720), "camera.yaml")
    five = {"distortion_coefficients": {"data": [0.1, 0.1, 0.0, 0.0, 0.1]}}
    path.write_text(to_yaml(data | five | {"distortion_model": "equidistant"}))
    with pytest.raises(ModcalError, match="plumb_bob"):
        read_camera_info(path)
    path.write_text("a: 1")
    with pytest.raises(ModcalError, match="camera_info"):
        read_camera_info(path)


def test_sheet_is_to_scale_and_the_same_every_time() -> None:
    sheet = draw_sheet(BOARD, "A4")
    assert sheet.pdf.startswith(b"%PDF")
    assert sheet.pdf == draw_sheet(BOARD, "A4").pdf
    assert sheet.rulers_m == pytest.approx((0.21, 0.15))
    with pytest.raises(ModcalError, match="larger paper"):
        draw_sheet(replace(BOARD, square=0.06, marker=0.04), "A4")


def test_the_printed_board_is_the_one_that_is_found() -> None:
    """The sheet's rectangles, filled in, are a board to the detector, 30 mm a square."""
    for board in (
        BOARD,
        PrintedTarget(CHESSBOARD, 7, 4, 0.03),
        PrintedTarget(ARUCO_GRID, 3, 2, 0.04, 0.01, "DICT_4X4_50"),
    ):
        page = np.full((900, 1100), 255, np.uint8)
        for x, y, w, h in rectangles(board):
            a, b = (np.rint(4.0 * np.array([[x, y], [x + w, y + h]])) + 100).astype(int)
            page[a[1] : b[1], a[0] : b[0]] = 0
        view = detect(cv2.GaussianBlur(page, (0, 0), 1.0), board, "page").view
        assert len(view) == len(board.points)
        assert view.pixels == pytest.approx(99.5 + 4000.0 * board.points[view.ids, :2], abs=0.6)

"""Lenses and targets: projections and corners against OpenCV, derivatives, intrinsics, files, sheets of another size."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera.boards import BOARD, LENS, SIZE, facing, seen, views
from camera.fits import AS_DRAWN, MEASURED, solved, true_error
from camera.scenes import scene
from finite_differences import assert_jacobian

from modcal_core.camera.bundle import APRIL_GRID, ARUCO_GRID, CHARUCO, CHESSBOARD, TAG, BoardView, PrintedTarget
from modcal_core.camera.claim import APPLY, CANNOT_TELL, DO_NOT_APPLY
from modcal_core.camera.corners import CornerTable, corner_rows, enough_corners
from modcal_core.camera.lens import FISHEYE, Lens
from modcal_core.camera.mounting import board_poses, first_lens, fit_lens
from modcal_core.camera.target_file import RULER_STD_M, read_target, scale_of_rulers, target_from_data, target_to_data
from modcal_core.camera.views import postures_in_view
from modcal_core.errors import BadTable, NotEnoughData
from modcal_core.files import to_yaml
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array

FLAT = np.zeros(5)
RATIONAL = Lens.of(LENS.K, [0.52, -2.7, 6e-4, -3e-4, 1.6, 0.4, -2.5, 1.5], SIZE)  # as depth cameras have them
PINHOLES = pytest.mark.parametrize("lens", [LENS, RATIONAL], ids=["plumb_bob", "rational_polynomial"])


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(25)


@PINHOLES
def test_projection_is_opencv_s(rng: np.random.Generator, lens: Lens) -> None:
    X = np.c_[rng.uniform(-0.2, 0.2, (50, 2)), rng.uniform(0.3, 0.6, 50)]
    expected = cv2.projectPoints(X, np.zeros(3), np.zeros(3), lens.K, np.r_[lens.values[4:], lens.below])[0].reshape(
        -1, 2
    )
    assert np.abs(lens.project(X) - expected).max() < 1e-9


@PINHOLES
def test_rays_undo_the_projection(rng: np.random.Generator, lens: Lens) -> None:
    xy = rng.uniform(-0.6, 0.6, (50, 2))
    assert np.abs(lens.rays(lens.project(np.c_[xy, np.ones(50)])) - xy).max() < 1e-10


@PINHOLES
def test_lens_derivatives(rng: np.random.Generator, lens: Lens) -> None:
    X = np.c_[rng.uniform(-0.2, 0.2, (5, 2)), rng.uniform(0.3, 0.6, 5)]
    _, by_point, by_values = lens.linearise(X)
    for i in range(5):
        assert_jacobian(lambda x: lens.project(x), by_point[i], X[i])
        assert_jacobian(lambda v, i=i: replace(lens, values=v).project(X[i]), by_values[i], np.array(lens.values))


def test_corner_derivatives(rng: np.random.Generator) -> None:
    T = facing(rng, 2)
    table = CornerTable.of(views(rng, T), BOARD)
    shape = np.array([0.01, -0.02, 2e-3, -1e-3, 3e-3])
    sweep = 0.2 * rng.normal(size=(2, 6))
    rows = corner_rows(table, LENS, shape, T, 0.02, sweep)

    def predicted(x: Array) -> Array:
        moved = se3.exp(np.stack([x[:6], x[6:12]])) @ T
        at = corner_rows(
            table, replace(LENS, values=LENS.values + x[12:21]), shape + x[21:26], moved, 0.02 + x[26], sweep
        )
        return -at.residual.ravel()

    J = np.zeros((2 * len(table), 27))
    first = 2 * table.of_view(0).stop
    pose = rows.by_pose.reshape(-1, 6)
    J[:first, :6], J[first:, 6:12] = pose[:first], pose[first:]
    J[:, 12:] = rows.by_common.reshape(-1, 15)
    assert_jacobian(predicted, J, np.zeros(27), tolerance=1e-7)


def test_a_board_far_away_has_a_twin(rng: np.random.Generator) -> None:
    """Another minimum, tilted to the other side of the line of sight, which noise makes about as good."""
    T = facing(rng, 20, near=3.0, far=4.0)
    T = T[np.arccos(T[:, 2, 2]) > 0.15]
    found = board_poses(CornerTable.of(views(rng, T, noise=0.02), BOARD), LENS, FLAT)
    apart = np.linalg.norm(so3.log(np.swapaxes(found.T[:, 0, :3, :3], 1, 2) @ found.T[:, 1, :3, :3]), axis=1)
    assert (apart > 0.1).mean() > 0.7
    assert (found.cost[:, 1] >= found.cost[:, 0]).all()
    off = np.linalg.norm(so3.log(np.swapaxes(found.T[:, :, :3, :3], 2, 3) @ T[:, None, :3, :3]), axis=2)
    assert (off.min(axis=1) < 0.05).all()


def test_corners_that_show_no_pose_leave_the_other_images_as_they_are(rng: np.random.Generator) -> None:
    """An image with corners of one row only, and one of which none is in use."""
    found = views(rng, facing(rng, 6))
    found[2] = found[2].select(found[2].ids < 6)
    table = CornerTable.of(found, BOARD)
    some = replace(table, weight=np.where(table.view == 4, 0.0, 1.0))
    T, every = board_poses(some, LENS).T[:, 0], board_poses(table, LENS).T[:, 0]
    assert np.isfinite(T).all()
    assert T[[0, 1, 3, 5]] == pytest.approx(every[[0, 1, 3, 5]], abs=1e-9)


def test_intrinsics_meet_opencv_s_minimum(rng: np.random.Generator) -> None:
    sheet = PrintedTarget(CHARUCO, 7, 5, 0.03125, 0.022)  # a square that single precision holds exactly
    found = views(rng, facing(rng, 12), board=sheet)
    single = [v.pixels.astype(np.float32).astype(float) for v in found]  # which is what OpenCV computes with
    white = [
        BoardView(v.name, v.ids, p, np.tile(np.eye(2), (len(v), 1, 1))) for v, p in zip(found, single, strict=True)
    ]
    table = CornerTable.of(white, sheet)
    fit = fit_lens(table, first_lens(table, SIZE))
    flags, end = 0, (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 500, 1e-15)
    points = [sheet.points[v.ids].astype(np.float32) for v in white]
    pixels = [v.pixels.astype(np.float32).reshape(-1, 1, 2) for v in white]
    rms = cv2.calibrateCamera(points, pixels, SIZE, None, None, flags=flags, criteria=end)[0]
    assert fit.cost == pytest.approx(rms**2 * len(table), rel=1e-6)


def test_square_on_views_do_not_show_the_focal_length(rng: np.random.Generator) -> None:
    T = se3.transform(np.eye(3), np.c_[rng.uniform(-0.1, 0.0, (5, 2)), rng.uniform(0.3, 0.5, 5)])
    straight = Lens(np.r_[LENS.values[:4], np.zeros(5)], SIZE)
    with pytest.raises(NotEnoughData, match="focal length"):
        first_lens(CornerTable.of(views(rng, T, noise=0.0, lens=straight), BOARD), SIZE)


WIDE = Lens(np.array([340.0, 341.0, 645.0, 355.0, 0.03, -0.012, 0.004, -0.001, 0.0]), SIZE, FISHEYE)


def test_a_fisheye_projects_as_opencv_s(rng: np.random.Generator) -> None:
    """Up to 80° off its axis, on the axis too; and back to rays; and its derivatives."""
    angle = np.radians(np.r_[0.0, rng.uniform(0.0, 80.0, 30)])
    about = rng.uniform(0.0, 2.0 * np.pi, 31)
    X = np.stack([np.sin(angle) * np.cos(about), np.sin(angle) * np.sin(about), np.cos(angle)], axis=1)
    assert np.abs(WIDE.project(X) - seen(np.eye(4), X, WIDE)).max() < 1e-7
    rays = WIDE.rays(WIDE.project(X))
    assert np.abs(rays - X[:, :2] / X[:, 2:]).max() < 1e-8
    _, by_point, by_values = WIDE.linearise(X[1:6])
    for i in range(5):
        assert_jacobian(WIDE.project, by_point[i], X[1 + i])
        assert_jacobian(
            lambda v, i=i: Lens(v, SIZE, FISHEYE).project(X[1 + i]), by_values[i], np.array(WIDE.values), tolerance=1e-6
        )


def test_a_fisheye_is_found_from_images_alone(rng: np.random.Generator) -> None:
    T = facing(rng, 20, near=0.12, far=0.3)
    table = CornerTable.of([v for v in views(rng, T, lens=WIDE) if len(v) >= 12], BOARD)
    fit = fit_lens(table, first_lens(table, SIZE, FISHEYE))
    assert fit.cost < 1.2 * 2.0 * len(table)
    found, true = (np.arctan(np.linalg.norm(lens.rays(table.pixels), axis=1)) for lens in (fit.lens, WIDE))
    assert np.abs(found - true).max() < 3e-3  # rad, out to 44° off the axis
    assert fit.lens.values[0] == pytest.approx(340.0, rel=0.01)


@pytest.mark.parametrize(
    ("ids", "enough"),
    [
        ([0, 1, 6, 7], True),
        ([0, 1, 6], False),
        ([0, 1, 2, 3, 4, 5], False),  # a row
        ([0, 1, 2, 8], False),  # three on a line and one: no homography goes through them alone
        ([2, 3, 7, 12], False),  # the same along a diagonal
        ([0, 1, 2, 3, 4, 5, 8, 9], True),
    ],
)
def test_corners_that_fix_a_pose(ids: list[int], enough: bool) -> None:
    assert enough_corners(BOARD.points[ids]) is enough


def test_charuco_corners_are_where_opencv_has_them() -> None:
    board = cv2.aruco.CharucoBoard((7, 5), 0.03, 0.022, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100))
    ours = PrintedTarget(CHARUCO, 7, 5, 0.03, 0.022, "DICT_5X5_100")
    assert np.abs(ours.points - np.asarray(board.getChessboardCorners())).max() < 1e-7
    assert ours.size == pytest.approx((0.21, 0.15))


def test_aruco_grid_corners_are_where_opencv_has_them() -> None:
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.GridBoard((4, 3), 0.04, 0.01, words)
    ours = PrintedTarget(ARUCO_GRID, 4, 3, 0.04, 0.01, "DICT_4X4_50")
    assert np.abs(ours.points - np.asarray(board.getObjPoints()).reshape(-1, 3)).max() < 1e-7


def test_kalibr_aprilgrid() -> None:
    data = {"target_type": "aprilgrid", "tagCols": 6, "tagRows": 5, "tagSize": 0.088, "tagSpacing": 0.3}
    grid = target_from_data(data, "aprilgrid.yaml")
    assert (grid.kind, grid.columns, grid.rows) == (APRIL_GRID, 6, 5)
    assert grid.points[:4, :2] == pytest.approx(np.array([[0, 0], [0.088, 0], [0.088, 0.088], [0, 0.088]]))
    assert grid.points[4] == pytest.approx([0.088 * 1.3, 0.0, 0.0])  # the next tag of the lowest row
    assert grid.points[4 * 6] == pytest.approx([0.0, 0.088 * 1.3, 0.0])  # the first of the row above


def test_kalibr_checkerboard_counts_inner_corners() -> None:
    data = {"target_type": "checkerboard", "targetCols": 6, "targetRows": 7, "rowSpacingMeters": 0.06}
    board = target_from_data(data | {"colSpacingMeters": 0.06}, "checkerboard.yaml")
    assert len(board.points) == 42
    with pytest.raises(BadTable, match="squares of"):
        target_from_data(data | {"colSpacingMeters": 0.05}, "checkerboard.yaml")


def test_file_and_measured_rulers(tmp_path: Path) -> None:
    path = tmp_path / "target.yaml"
    board = PrintedTarget(CHARUCO, 7, 5, 0.03, 0.022, "DICT_5X5_100")
    data = target_to_data(board, (0.2, 0.1))
    path.write_text(to_yaml(data))
    assert read_target(path) == board
    data["rulers"] |= {"measured_x_m": 0.198, "measured_y_m": 0.101}
    path.write_text(to_yaml(data))
    scale = read_target(path).scale
    assert scale.measured
    assert (scale.x, scale.y) == pytest.approx((0.99, 1.01))
    assert scale.known[0] < board.scale.known[0]
    assert scale.unsaid
    data["rulers"]["measured_std_m"] = 3e-5  # with a calliper
    assert target_from_data(data, "target.yaml").scale.known == pytest.approx(0.01 * np.array(scale.known))
    data["rulers"]["measured_x_m"] = 198.0
    with pytest.raises(BadTable, match="in metres"):
        target_from_data(data, "target.yaml")


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (3, "is not a target file"),
        ({"modcal_target": 2}, "format 2"),
        ({"modcal_target": 1, "type": "circles"}, "not known"),
        ({"modcal_target": 1, "type": "charuco", "columns": 7, "rows": 5}, "cannot be read"),
        ({"modcal_target": 1, "type": "charuco", "columns": 7, "rows": 5, "square_m": 30, "marker_m": 22}, "in metres"),
        ({"modcal_target": 1, "type": "charuco", "columns": 10**9, "rows": 5, "square_m": 1}, "allowed"),
        ({"modcal_target": 1, "type": "charuco", "columns": 7, "rows": 5, "square_m": 0.02, "marker_m": 0.03}, "fit"),
        ({"target_type": "circlegrid"}, "is not read"),
    ],
)
def test_bad_files_are_refused(data: object, said: str) -> None:
    with pytest.raises(BadTable, match=said):
        target_from_data(data, "target.yaml")


def test_a_chessboard_that_looks_the_same_turned_is_refused() -> None:
    with pytest.raises(BadTable, match="turned by half a turn"):
        PrintedTarget(CHESSBOARD, 9, 7, 0.03)
    assert len(PrintedTarget(CHESSBOARD, 9, 6, 0.03).points) == 40
    assert len(PrintedTarget(TAG, 1, 1, 0.1, dictionary="DICT_APRILTAG_36h11", first_id=3).points) == 4


def test_rulers_of_different_lengths_are_known_differently() -> None:
    """Each to 0.3 mm of its own length, independently of the other."""
    scale = scale_of_rulers((0.21, 0.15), (0.2102, 0.1499), "rulers", 3e-4)
    assert scale.covariance == pytest.approx(np.diag([3e-4 / 0.21, 3e-4 / 0.15]) ** 2)


@pytest.mark.slow
def test_without_anything_metric_nothing_can_be_told() -> None:
    s = scene(1, True, count=15, board=BOARD)
    r = solved(s)
    assert r.claim.decision.word == CANNOT_TELL
    assert "rulers" in r.claim.decision.because[0]
    whole, known = r.claim.shares["print scale"]
    assert known < 0.5 * whole  # which is what a ruler would tell


@pytest.mark.slow
def test_squares_of_another_size_are_named() -> None:
    """Printed 10 % too large: the arm's links could take it up, which no arm is built like."""
    s = scene(21, True, count=15, length_std=1e-3, angle_std=2e-3, printed=1.1 * BOARD.points, board=MEASURED)
    r = solved(s)
    assert r.claim.decision.word == DO_NOT_APPLY
    assert re.search(r"a sheet \+(9|10)\.", r.claim.decision.because[0])
    assert "scale than its URDF" in r.claim.decision.because[0]


@pytest.mark.slow
def test_a_sheet_that_a_bad_arm_hides_is_not_trusted() -> None:
    """Rulers stated at their nominal lengths, a sheet 2 % larger, an arm 4 mm off a body: images do not decide, which is
    said, with what would tell, and how far off the arm could be were the size wrong.
    """
    s = scene(33, False, count=20, length_std=4e-3, angle_std=5e-3, board=AS_DRAWN, printed=1.02 * BOARD.points)
    r = solved(s)
    q = postures_in_view(r.fit, np.random.default_rng(1))
    assert r.claim.decision.word == CANNOT_TELL
    assert "state how well (--measured-to-mm)" in r.claim.decision.because[0]
    assert true_error(s, r.fit, q) < r.claim.rests_on.if_wrong_m
    assert any("look much alike" in said or "a sheet +" in said for said in r.claim.decision.because)
    clean = solved(replace(s, board=MEASURED, views=views(np.random.default_rng(0), s.T, board=s.board)))
    assert clean.claim.decision.word == APPLY
    assert clean.claim.in_view.interval[2] < 4e-3
    assert "rests on the sheet's stated size" in clean.claim.decision.because[-1]


def test_rulers_of_which_nobody_says_how_well_they_were_read_count_as_any_statement() -> None:
    """One in twenty is of another sheet, whatever the images say against it; of rulers that were read with care that
    is up to the images.
    """
    s = scene(34, True, count=12, length_std=4e-3, angle_std=5e-3)
    found = {}
    for std in (None, RULER_STD_M):
        board = replace(BOARD, scale=scale_of_rulers((0.2, 0.12), (0.2008, 0.1205), "rulers", std))
        found[std] = solved(replace(s, board=board), look_for_effects=False).claim
    assert found[None].in_view.by["size"].chance >= 0.0499
    assert "look much alike" in found[None].decision.doubtful[0]
    assert found[RULER_STD_M].in_view.by["size"].chance < 0.03

"""Targets: where corners are, the files that describe them, and sheets of another size than stated."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera.boards import BOARD, views
from camera.fits import AS_DRAWN, MEASURED, solved, true_error
from camera.scenes import scene

from modcal_core.camera.bundle import APRIL_GRID, ARUCO_GRID, CHARUCO, CHESSBOARD, TAG, PrintedTarget
from modcal_core.camera.claim import APPLY, CANNOT_TELL, DO_NOT_APPLY
from modcal_core.camera.target_file import RULER_STD_M, read_target, scale_of_rulers, target_from_data, target_to_data
from modcal_core.camera.views import postures_in_view
from modcal_core.errors import BadTable
from modcal_core.files import to_yaml


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
def test_a_sheet_of_another_size_is_named() -> None:
    """Printed 5 % too large, and measured by nobody; the arm is known to a millimetre."""
    s = scene(4, True, count=15, length_std=3e-4, angle_std=5e-4, printed=1.05 * BOARD.points)
    r = solved(s, arm_m=1e-3)
    assert r.claim.decision.word == DO_NOT_APPLY
    assert re.search(r"\+(4\.9|5\.[01])\d % \(x\)", r.claim.decision.because[0])


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
    assert r.claim.rests_on is not None
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

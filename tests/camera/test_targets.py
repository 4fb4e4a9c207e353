"""Targets: where corners are, and the files that describe them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from modcal_core.camera.bundle import APRIL_GRID, ARUCO_GRID, CHARUCO, CHESSBOARD, TAG, PrintedTarget
from modcal_core.camera.target_file import read_target, scale_of_rulers, target_from_data, target_to_data
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

"""Printed targets: where their corners are, each with a number that never changes.

A target's frame has x to the right of the sheet, y down it and z into it, as OpenCV's boards have; its origin is the
sheet's upper left corner of the pattern. AprilGrids are written in Kalibr's frame: x right, y up, z out of the sheet.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import Array

CHARUCO, CHESSBOARD, ARUCO_GRID, APRIL_GRID, TAG = "charuco", "chessboard", "aruco_grid", "aprilgrid", "tag"
MARKER_CORNERS = 4  # of a square marker
_LARGEST = 200  # squares or markers a side; more is a slip of the pen, and would take all memory
_LARGEST_M = 10.0  # m; a square or marker of that size is in millimetres


@dataclass(frozen=True)
class PrintScale:
    """How much larger than stated the sheet is, in x and y, and how well that is known.

    x, y: ratio to what the file states. std: relative standard deviation of what x and y share. std_apart: of their
    difference. leaning: covariance of these two, where one of x and y is known better. measured: whether somebody has
    measured it. nominal: whether what was measured is what the file states, and nobody said how well. unsaid: whether
    nobody said how well it was measured, whatever it was.
    """

    x: float = 1.0
    y: float = 1.0
    std: float = 0.01  # a printer that fits to the page, or feeds unevenly, is off by up to a few per cent
    std_apart: float = 0.003  # paper feed against the width of the head
    measured: bool = False
    leaning: float = 0.0
    nominal: bool = False
    unsaid: bool = False

    @property
    def covariance(self) -> Array:
        """Covariance (2, 2) of the print scales along x and y."""
        shared, apart = self.std**2, (0.5 * self.std_apart) ** 2
        other = shared - apart
        return np.array([[shared + apart + self.leaning, other], [other, shared + apart - self.leaning]])


class CalibrationTarget(Protocol):
    """What a fit asks of a target: points with numbers, and by how much each may be elsewhere than stated."""

    @property
    def scale(self) -> PrintScale:
        """How large it came out: the first two values of its shape."""
        ...

    @property
    def points(self) -> Array:
        """Where its points are as stated, (C, 3) [m]."""
        ...

    @property
    def label(self) -> str:
        """The target as text."""
        ...

    @property
    def values_of_place(self) -> int:
        """How many values the place of each of its markers has: 0 where they are as stated, 3 or 6."""
        ...

    @property
    def marker_count(self) -> int:
        """How many markers have a place of their own."""
        ...

    def shape_modes(self) -> Array:
        """How each point moves per unit of the five values of the shape, (C, 3, 5)."""
        ...

    def on_markers(self) -> tuple[np.ndarray, Array]:
        """(number of the marker of each point, (C,), where the point is from the middle of that, (C, 3) [m])."""
        ...


@dataclass(frozen=True)
class PrintedTarget:
    """A flat sheet with corners.

    kind: charuco, chessboard, aruco_grid, aprilgrid or tag. columns, rows: squares of a board, markers of a grid.
    square: side of a square of a board, or of a marker of a grid [m]. marker: side of the markers inside a ChArUco
    board, or the gap between those of a grid [m]; 0 where there is none. dictionary: name of the markers' dictionary,
    as OpenCV has it; empty where there are none. first_id: of the markers. scale: how large the sheet came out.
    """

    kind: str
    columns: int
    rows: int
    square: float
    marker: float = 0.0
    dictionary: str = ""
    first_id: int = 0
    scale: PrintScale = PrintScale()

    def __post_init__(self) -> None:
        """Raises BadTable for a target that cannot be printed."""
        least = {CHARUCO: 3, CHESSBOARD: 4}.get(self.kind, 1)  # a chessboard is found by nine corners or more
        if not (least <= self.columns <= _LARGEST and least <= self.rows <= _LARGEST):
            said = f"has {self.columns} × {self.rows} squares, {least} to {_LARGEST} a side are allowed"
            raise BadTable(f"target {self.kind}", said, "count the squares, or markers, of the sheet")
        if not 0.0 < self.square < _LARGEST_M or not 0.0 <= self.marker < _LARGEST_M:
            said = f"has a side of {self.square:g} m, 0 to {_LARGEST_M:g} m is allowed"
            raise BadTable(f"target {self.kind}", said, "give lengths in metres")
        if self.kind == CHARUCO and not 0.0 < self.marker < self.square:
            said = f"has markers of {1e3 * self.marker:g} mm in squares of {1e3 * self.square:g} mm"
            raise BadTable("target charuco", said, "give markers that fit into the squares")
        if self.kind == CHESSBOARD and (self.columns - self.rows) % 2 == 0:
            said = f"{self.columns} × {self.rows} squares look the same turned by half a turn"
            raise BadTable("target chessboard", said, "use one odd and one even number of squares, or a ChArUco board")

    @property
    def ids(self) -> np.ndarray:
        """Numbers of the corners, (C,): 0 … C − 1 in the order of ``points``."""
        return np.arange(len(self.points))

    @property
    def points(self) -> Array:
        """Where the corners are as stated, (C, 3) [m], z = 0.

        Of a board the inner corners, row by row. Of a grid the four of each marker: from the upper left one clockwise,
        or, of an AprilGrid, from the lower left one counter-clockwise, and its markers from the lower left row by row.
        """
        if self.kind in (CHARUCO, CHESSBOARD):
            row, column = np.divmod(np.arange((self.columns - 1) * (self.rows - 1)), self.columns - 1)
            flat = self.square * np.stack([column + 1, row + 1], axis=1)
        else:
            row, column = np.divmod(np.arange(self.columns * self.rows), self.columns)
            corner = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
            flat = (self.square + self.marker) * np.stack([column, row], axis=1)[:, None] + self.square * corner
        out = np.zeros((flat.size // 2, 3))
        out[:, :2] = flat.reshape(-1, 2)
        return out

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the pattern as stated [m]."""
        gap = self.marker if self.kind in (ARUCO_GRID, APRIL_GRID) else 0.0
        return (self.columns * (self.square + gap) - gap, self.rows * (self.square + gap) - gap)

    @property
    def label(self) -> str:
        """The target as text, such as "ChArUco board of 7 × 5 squares of 30 mm"."""
        names = {CHARUCO: "ChArUco board", CHESSBOARD: "chessboard", ARUCO_GRID: "ArUco grid", APRIL_GRID: "AprilGrid"}
        if self.kind == TAG:
            return f"tag {self.first_id} of {1e3 * self.square:g} mm"
        what = "squares" if self.kind in (CHARUCO, CHESSBOARD) else "markers"
        return f"{names[self.kind]} of {self.columns} × {self.rows} {what} of {1e3 * self.square:g} mm"

    @property
    def values_of_place(self) -> int:
        """Number of values of a marker's place: 0, because a sheet is printed in one piece."""
        return 0

    @property
    def marker_count(self) -> int:
        """Number of markers with their own place: none."""
        return 0

    def shape_modes(self) -> Array:
        """How each corner moves per unit of its size along x, along y, and of three modes of bow, (C, 3, 5)."""
        points = self.points
        middle, half = 0.5 * (points.max(0) + points.min(0)), 0.5 * float(np.linalg.norm(np.ptp(points, axis=0)))
        x, y = ((points - middle)[:, :2] / half).T
        out = np.zeros((len(points), 3, 5))
        out[:, 0, 0], out[:, 1, 1] = points[:, 0], points[:, 1]
        out[:, 2, 2:] = np.stack([x * x, x * y, y * y], axis=1)
        return out

    def on_markers(self) -> tuple[np.ndarray, Array]:
        """No corner is on a marker of its own."""
        return np.zeros(len(self.points), int), np.zeros((len(self.points), 3))

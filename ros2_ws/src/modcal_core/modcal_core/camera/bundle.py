"""Targets: printed sheets and bodies with markers, where their points are, each with a number that never changes.

A sheet's frame has x to the right, y down and z into it, as OpenCV's boards have; its origin is the upper left corner
of the pattern. AprilGrids are written in Kalibr's frame: x right, y up, z out of the sheet.

Of a body a drawing says where each marker is; the body itself was glued together by hand. So each marker has a place of
its own in a fit, three values, six where its corners are read, and the body a size. A marker's frame has x to its
right, y up and z towards who looks at it, as those of ArUco and apriltag_ros; its origin is the middle.

All markers moved as one body are a motion of the target. So in the units of their tolerances the six motions as a body
are held: in the target's frame its markers' offsets add up to no motion. How large the offsets are against the
tolerances is one of the sizes that the data decide.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.geometry import Array, se3, so3, view

CHARUCO, CHESSBOARD, ARUCO_GRID, APRIL_GRID, TAG = "charuco", "chessboard", "aruco_grid", "aprilgrid", "tag"
MARKER_CORNERS = 4  # of a square marker
_LARGEST = 200  # squares or markers a side; more is a slip of the pen, and would take all memory
_LARGEST_M = 10.0  # m; a square, marker or body of that size is in millimetres


def require(ok: bool, offender: str, said: str, remedy: str) -> None:
    """Raises BadTable unless something is so."""
    if not ok:
        raise BadTable(offender, said, remedy)


def alike(std: float, std_apart: float) -> tuple[float, float, float]:
    """Variance of x, covariance, variance of y where both share a relative error, and differ by another."""
    shared, apart = std**2, (0.5 * std_apart) ** 2
    return shared + apart, shared - apart, shared + apart


@dataclass(frozen=True)
class PrintScale:
    """How much larger than stated the sheet is, in x and y, and how well that is known.

    x, y: ratio to what the file states. known: relative variance of x, covariance, variance of y; of a print of which
    nothing is known those of a printer that fits to the page, or feeds unevenly. measured: whether somebody has
    measured it. unsaid: whether nobody said how well.
    """

    x: float = 1.0
    y: float = 1.0
    known: tuple[float, float, float] = alike(0.01, 0.003)
    measured: bool = False
    unsaid: bool = False

    @property
    def covariance(self) -> Array:
        """Covariance (2, 2) of the print scales along x and y."""
        x, both, y = self.known
        return np.array([[x, both], [both, y]])


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
    values_of_place: ClassVar[int] = 0  # of a marker: a sheet is printed in one piece
    marker_count: ClassVar[int] = 0  # with a place of their own

    def __post_init__(self) -> None:
        """Raises BadTable for a target that cannot be printed."""
        least = {CHARUCO: 3, CHESSBOARD: 4}.get(self.kind, 1)  # a chessboard is found by nine corners or more
        name, squares = f"target {self.kind}", f"{self.columns} × {self.rows} squares"
        said = f"has {squares}, {least} to {_LARGEST} a side are allowed"
        allowed = least <= min(self.columns, self.rows) and max(self.columns, self.rows) <= _LARGEST
        require(allowed, name, said, "count the squares, or markers, of the sheet")
        said = f"has a side of {self.square:g} m, 0 to {_LARGEST_M:g} m is allowed"
        lengths = 0.0 < self.square < _LARGEST_M and 0.0 <= self.marker < _LARGEST_M
        require(lengths, name, said, "give lengths in metres")
        said = f"has markers of {1e3 * self.marker:g} mm in squares of {1e3 * self.square:g} mm"
        fits = self.kind != CHARUCO or 0.0 < self.marker < self.square
        require(fits, name, said, "give markers that fit into the squares")
        differs = self.kind != CHESSBOARD or (self.columns - self.rows) % 2 == 1
        remedy = "use one odd and one even number of squares, or a ChArUco board"
        require(differs, name, f"{squares} look the same turned by half a turn", remedy)

    @property
    def points(self) -> Array:
        """Where the corners are as stated, by their numbers, (C, 3) [m], z = 0.

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


_HELD = 1e6  # times the information of the tolerances: the body's frame is then theirs to a thousandth of them


@dataclass(frozen=True)
class PlacePrior:
    """What is expected of the places of K markers, v values each. white: takes offsets of each to units of its
    tolerances, (K, v, v). motion: of each by the six motions of them all as one body, (K, v, 6).
    """

    white: Array
    motion: Array

    @cached_property
    def held(self) -> Array:
        """Information about what all are off together, whatever their offsets, (Z, Z) [1/m², 1/rad²]."""
        K, values, _ = self.motion.shape
        U = np.linalg.qr((self.white @ self.motion).reshape(-1, 6))[0].reshape(K, values, 6)
        U = (self.white @ U).reshape(K * values, 6)
        return np.asarray(_HELD * U @ U.T)

    @cached_property
    def apart(self) -> Array:
        """The same about what they are off apart from each other, at the stated tolerances."""
        from scipy.linalg import block_diag  # where a bag is only looked into, nothing loads SciPy

        return np.asarray(block_diag(*(self.white @ self.white)) - self.held / _HELD)

    def information(self, size: float) -> Array:
        """Information matrix of the marker places, (Z, Z). size: scale of the offsets in units of the tolerances."""
        return np.asarray(self.apart / size**2 + self.held)


@dataclass(frozen=True)
class BoardView:
    """The corners of the target in one image.

    name: of the image. ids: numbers of the corners, (m,). pixels: (m, 2). cov: of each corner [px²], (m, 2, 2).
    sharpness: width of the edges [px], NaN where unknown. stamp: [s], NaN where unknown.
    """

    name: str
    ids: np.ndarray
    pixels: Array
    cov: Array
    sharpness: float = float("nan")
    stamp: float = float("nan")

    def __post_init__(self) -> None:
        for name in ("ids", "pixels", "cov"):
            object.__setattr__(self, name, view(getattr(self, name)))

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, rows: np.ndarray) -> BoardView:
        """The view with these corners only (mask or indices)."""
        return BoardView(self.name, self.ids[rows], self.pixels[rows], self.cov[rows], self.sharpness, self.stamp)


BUNDLE = "bundle"
_CORNERS = {"ul": (-1.0, 1.0), "ur": (1.0, 1.0), "lr": (1.0, -1.0), "ll": (-1.0, -1.0)}  # of a marker, x and y
ARUCO_ORDER, APRILTAG_ORDER = ("ul", "ur", "lr", "ll"), ("ll", "lr", "ur", "ul")  # as their detectors number them
PLACE_M, TURN_RAD = 1e-3, 1e-2  # of a label stuck on by hand: a millimetre, and as much over 100 mm
SIZE, PRINT = 5e-3, 1e-2  # of a printed body, which shrinks by some tenths of a per cent, and of a printer's labels
_MAX = 500  # markers; more is a slip of the pen
_MIN_MARKERS = 3  # not on one line: fewer have no pose


@dataclass(frozen=True)
class BundleMarker:
    """id: as detectors have it. xyz [m], quaternion x y z w: of T_body_marker. size: of its side [m], 0 of a point."""

    id: int
    xyz: tuple[float, float, float]
    quaternion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    size: float = 0.0

    @property
    def T_body_marker(self) -> Array:
        """Its pose on the body, (4, 4) [m]."""
        return se3.transform(so3.from_quaternion(np.array(self.quaternion)), np.array(self.xyz))

    @property
    def label(self) -> str:
        """The marker as text."""
        return f"{'marker' if self.size else 'point'} {self.id}"


@dataclass(frozen=True)
class MarkerBundle:
    """A body with markers. scale: of the body (its x) and of the print of the markers (its y). place_m, turn_rad: how
    far each is from its place, and turned, along or about an axis, standard deviation. corners: names of a marker's in
    their order. dictionary: of the markers, as OpenCV has it. turning: whether corners are read, so that markers' turns
    are seen. normal_m: how far a marker is from its place along its own normal, where that is known apart.

    Its points are, of each marker in turn, the four corners and the middle; of a bare point itself.
    """

    markers: tuple[BundleMarker, ...]
    scale: PrintScale
    place_m: float = PLACE_M
    turn_rad: float = TURN_RAD
    corners: tuple[str, ...] = ARUCO_ORDER
    dictionary: str = ""
    name: str = ""
    turning: bool = False
    normal_m: float | None = None

    def __post_init__(self) -> None:
        """Raises BadTable for a body that no fit can place."""
        name, count = f"target {BUNDLE}", Counter(m.id for m in self.markers)
        said = f"has {len(self.markers)} markers, 1 to {_MAX} are allowed"
        require(1 <= len(self.markers) <= _MAX, name, said, "list the markers")
        often, times = count.most_common(1)[0]
        require(times == 1, name, f"has marker {often} twice", "give each marker a number of its own")
        near = bool((np.abs(self.middles) <= _LARGEST_M).all())
        require(near, name, f"reaches beyond {_LARGEST_M:g} m", "give lengths in metres")
        sides = all(0.0 <= m.size < _LARGEST_M for m in self.markers)
        require(sides, name, "has a marker whose side is no length", "give lengths in metres")
        said, remedy = f"has corner_order {' '.join(self.corners)[:40]}", f"name each of {', '.join(_CORNERS)} once"
        require(sorted(self.corners) == sorted(_CORNERS), name, said, f"{remedy}, in their order")
        known = self.place_m if self.normal_m is None else self.normal_m
        small = min(self.place_m, known) > 0.0 and max(self.place_m, known) < _LARGEST_M and 0.0 < self.turn_rad < np.pi
        require(small, name, "has a tolerance that is none", "give small positive numbers in SI units")

    @cached_property
    def middles(self) -> Array:
        """Nominal centres of the markers, (K, 3) [m]."""
        return np.array([m.xyz for m in self.markers], dtype=float).reshape(-1, 3)

    @cached_property
    def _layout(self) -> tuple[np.ndarray, Array, Array]:
        """(marker, place from its middle in the body's frame [m], normal of its face, 0 of a bare point) of points."""
        square = 0.5 * np.array([(*_CORNERS[name], 0.0) for name in self.corners] + [(0.0, 0.0, 0.0)])
        marker, lever, normal = [], [], []
        for k, one in enumerate(self.markers):
            R = one.T_body_marker[:3, :3]
            own = one.size * square @ R.T if one.size else np.zeros((1, 3))
            marker += [k] * len(own)
            lever.append(own)
            normal += [R[:, 2] if one.size else np.zeros(3)] * len(own)
        return np.array(marker), np.concatenate(lever), np.array(normal)

    @property
    def points(self) -> Array:
        """Where its points are nominally, (C, 3) [m]."""
        marker, lever, _ = self._layout
        return np.asarray(self.middles[marker] + lever)

    @property
    def normals(self) -> Array:
        """Outward normals of the faces of the points, (C, 3); zero for points without a face."""
        return self._layout[2]

    @property
    def label(self) -> str:
        """The target as text, such as "body of 20 markers"."""
        what = "markers" if any(m.size for m in self.markers) else "points"
        return f"{self.name or 'body'} of {len(self.markers)} {what}"

    @property
    def values_of_place(self) -> int:
        """Number of values of a marker's place: 3, or 6 where its corners are read."""
        return 6 if self.turning else 3

    @property
    def marker_count(self) -> int:
        """Number of markers, each with its own place."""
        return len(self.markers)

    def shape_modes(self) -> Array:
        """How each point moves per unit of the body's size, and of the markers', (C, 3, 5); a body has no bow."""
        marker, lever, _ = self._layout
        out = np.zeros((len(marker), 3, 5))
        out[:, :, 0] = (self.middles - self.middles.mean(axis=0))[marker]
        out[:, :, 1] = lever
        return out

    def on_markers(self) -> tuple[np.ndarray, Array]:
        """(marker of each point, (C,), where the point is from the middle of that, (C, 3) [m])."""
        return self._layout[:2]

    def point(self, marker: int, corner: int | None) -> int | None:
        """The number of a point: a marker's corner, 0 to 3, or its middle; None where the body has none such."""
        own = np.flatnonzero(np.array([m.id for m in self.markers])[self._layout[0]] == marker)
        if not len(own) or not (corner is None or 0 <= corner < len(own) - 1):
            return None
        return int(own[-1 if corner is None else corner])

    def place_prior(self) -> PlacePrior:
        """What is expected of the places of its K markers."""
        K, values = len(self.markers), self.values_of_place
        white, motion = np.zeros((K, values, values)), np.zeros((K, values, 6))
        for k, one in enumerate(self.markers):
            R = one.T_body_marker[:3, :3]
            off_face = self.place_m if self.normal_m is None or not one.size else self.normal_m
            white[k, :3, :3] = R / np.array([self.place_m, self.place_m, off_face]) @ R.T
            white[k, 3:, 3:] = np.eye(values - 3) / self.turn_rad
        motion[:, :3, :3] = np.eye(3)
        motion[:, :3, 3:] = -so3.hat(self.middles - self.middles.mean(axis=0))
        motion[:, 3:, 3:] = np.eye(3)[: values - 3]
        return PlacePrior(white, motion)

    def seen_by(self, ids: np.ndarray) -> MarkerBundle:
        """The body of which these points are seen, its markers turning where corners are among them.

        Raises BadTable for fewer than three markers, or markers on one line, unless corners are read.
        """
        marker, lever, _ = self._layout
        kept = np.unique(marker[ids])
        turning = bool((np.abs(lever[ids]).max(axis=1) > 0.0).any())
        spread = np.linalg.svd(self.middles[kept] - self.middles[kept].mean(axis=0), compute_uv=False)
        enough = turning or (len(kept) >= _MIN_MARKERS and spread[1] >= 0.01 * spread[0])
        said = f"shows {len(kept)} points, at least {_MIN_MARKERS} that are not on one line are needed"
        require(enough, self.label, said, "give more of them, or the corners of the markers")
        return replace(self, turning=turning)


CalibrationTarget = PrintedTarget | MarkerBundle


def body_scale(size: float | None, printed: float = PRINT) -> PrintScale:
    """How well the size of a body is known, and that of its markers, each by itself.

    size: relative standard deviation, None where nobody states it. printed: of the markers' sides.
    """
    return PrintScale(1.0, 1.0, ((SIZE if size is None else size) ** 2, 0.0, printed**2), size is not None)

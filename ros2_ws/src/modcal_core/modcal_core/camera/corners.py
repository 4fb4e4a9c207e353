"""All corners of all images as one table, and the equations of each image: how its corners move with everything.

A corner of an image with the target at T (camera's frame) stands at X = R x + p with x its place on the sheet. A small
twist (a, b) of the target, seen from the camera, moves it by a + b × X; the lens by its own derivative; the sheet's
shape, and on a body its marker's place, by R dx. A rolling shutter sees each row later than the one above it, counted
from the middle row. Rows are whitened by the corners' covariance. A fit needs of an image the product of its rows with
each other, 22 × 22 and the places of markers, however many corners there are.

The sheet's size, its flatness and the lens's higher terms are fitted with expectations and not left out, so that what
they may do to the arm is in its uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from modcal_core.camera.bundle import BoardView, CalibrationTarget, MarkerBundle, PlacePrior
from modcal_core.camera.lens import COUNT as LENS
from modcal_core.camera.lens import FISHEYE, PINHOLE, Lens
from modcal_core.geometry import Array, so3

POSE = 6  # values of a pose
SHAPE_NAMES = ("scale_x", "scale_y", "bow_xx", "bow_xy", "bow_yy")
SHAPE = len(SHAPE_NAMES)  # scale [1], bow at the edge of the sheet [m]
SCALE, BOW = slice(LENS, LENS + 2), slice(LENS + 2, LENS + SHAPE)  # where these stand among what all images share
READOUT = LENS + SHAPE  # the time in which a rolling shutter goes down an image [s]
COMMON = READOUT + 1  # what all images share, but for the places of the markers on a body, which stand behind it
BEHIND = 1e-3  # m in front of the camera at least; a corner behind it has no image


@dataclass(frozen=True)
class CornerTable:
    """M corners of N images: names of the images, and by row view: image, ascending, (M,). ids: number on the target,
    (M,). pixels: (M, 2). white: (M, 2, 2), makes errors white. weight: 1 used, 0 left out, (M,).
    """

    names: tuple[str, ...]
    target: CalibrationTarget
    view: np.ndarray
    ids: np.ndarray
    pixels: Array
    white: Array
    weight: Array

    @classmethod
    def of(cls, views: Sequence[BoardView], target: CalibrationTarget) -> CornerTable:
        """The corners of these views of this target."""
        ids = np.concatenate([v.ids for v in views]).astype(int)
        view = np.repeat(np.arange(len(views)), [len(v) for v in views])
        white = np.linalg.inv(np.linalg.cholesky(np.concatenate([v.cov for v in views])))
        names, pixels = tuple(v.name for v in views), np.concatenate([v.pixels for v in views])
        return cls(names, target, view, ids, pixels, white, np.ones(len(ids)))

    def __len__(self) -> int:
        return len(self.view)

    @property
    def views(self) -> int:
        """Number of images."""
        return len(self.names)

    @cached_property
    def points(self) -> Array:
        """On the target as stated, (M, 3) [m]."""
        return self.target.points[self.ids]

    @cached_property
    def modes(self) -> Array:
        """How each moves per unit of what a target's shape is, (M, 3, 5)."""
        return self.target.shape_modes()[self.ids]

    @cached_property
    def on_markers(self) -> tuple[np.ndarray, Array]:
        """(marker of each, (M,), where it is from the middle of that, (M, 3))."""
        marker, lever = self.target.on_markers()
        return marker[self.ids], lever[self.ids]

    @property
    def marker(self) -> np.ndarray:
        """Marker of each, (M,)."""
        return self.on_markers[0]

    @property
    def places(self) -> int:
        """Values of each marker's place, 0 of a flat sheet."""
        return self.target.values_of_place

    @property
    def markers(self) -> int:
        """Number of markers."""
        return self.target.marker_count

    def rms(self, gap: Array) -> float:
        """RMS of residuals (M, 2) of the corners in use."""
        return float(np.sqrt((self.weight @ (gap**2).sum(1)) / max(self.weight.sum(), 1.0)))

    @property
    def left_out(self) -> float:
        """Share of corners left out."""
        return 1.0 - float(self.weight.mean())

    def select(self, views: np.ndarray) -> CornerTable:
        """The corners of these images (mask (N,)), the images renumbered."""
        rows, number = np.asarray(views, bool)[self.view], np.cumsum(views) - 1
        some = {name: getattr(self, name)[rows] for name in ("ids", "pixels", "white", "weight")}
        names = tuple(name for name, keep in zip(self.names, views, strict=True) if keep)
        return replace(self, names=names, view=number[self.view[rows]], **some)

    def of_view(self, i: int) -> slice:
        """Rows of an image."""
        first, last = np.searchsorted(self.view, [i, i + 1])
        return slice(int(first), int(last))

    def on_target(self, shape: Array) -> Array:
        """Where the corners are on a target of this shape (5,), and with its markers so placed (5 + Z,), (M, 3) [m]."""
        out = self.points + self.modes @ shape[:SHAPE]
        if len(shape) > SHAPE:
            marker, lever = self.on_markers
            moved = shape[SHAPE:].reshape(self.markers, self.places)[marker]
            out += moved[:, :3] + (np.cross(moved[:, 3:], lever) if self.places == POSE else 0.0)
        return out

    def by_places(self, on: Array) -> Array:
        """Derivatives (M, 2, Z) by the places of all markers. on: by the corners on the target, (M, 2, 3)."""
        (marker, lever), out = self.on_markers, np.zeros((len(self), 2, self.places * self.markers))
        own = on if self.places != POSE else np.concatenate([on, -on @ so3.hat(lever)], axis=2)
        columns = self.places * marker[:, None] + np.arange(self.places)
        np.put_along_axis(out, np.broadcast_to(columns[:, None], own.shape), own, axis=2)
        return out


MIN_CORNERS = 4  # of an image, not on one line: the fewest that a homography is taken from
_ONE_LINE = 0.1  # of its length, how wide a group of corners is that is none
_ALL_BUT_ONE = 0.03  # the same once any one of them is left out; of a board's corners on a line nothing, of others 0.05


def enough_corners(points: Array) -> bool:
    """Whether corners at these places on the target (m, 3) fix its pose: four of them, of which no three are on a line.

    That is so where they are not on one line, and are not once any one of them is left out.
    """
    m = len(points)
    if m < MIN_CORNERS:
        return False
    off = points - points.mean(axis=0)
    scatter = off.T @ off
    without = scatter - m / (m - 1.0) * off[:, :, None] * off[:, None]
    spread = np.linalg.eigvalsh(np.concatenate([scatter[None], without]))
    width = np.sqrt(np.maximum(spread[:, 1], 0.0) / spread[:, 2])
    return bool(width[0] > _ONE_LINE and width[1:].min() > _ALL_BUT_ONE)


def images_with_pose(table: CornerTable) -> np.ndarray:
    """Images (N,) whose corners in use show a pose by themselves."""
    kept = [table.points[(table.view == i) & (table.weight > 0.0)] for i in range(table.views)]
    return np.array([enough_corners(points) for points in kept], dtype=bool)


@dataclass(frozen=True)
class CornerRows:
    """Whitened rows of M corners: residual (M, 2), measured minus predicted, and derivatives of the prediction.

    by_pose: (M, 2, 6), by the twist of the target seen from the camera. by_common: (M, 2, 15 + Z), by lens, shape,
    readout and the places of markers. pixels: residual in pixels, (M, 2).
    """

    residual: Array
    by_pose: Array
    by_common: Array
    pixels: Array


def corner_rows(
    table: CornerTable,
    lens: Lens,
    shape: Array,
    T_camera_target: Array,
    readout_s: float = 0.0,
    sweep: Array | None = None,
) -> CornerRows:
    """The rows of all corners, the target being at T_camera_target (N, 4, 4) in each image, at its middle row.

    shape: (5,), or with the places of markers behind it, (5 + Z,). readout_s: of a rolling shutter. sweep: twist of the
    target a second, seen from the camera, (N, 6); None: it stands.
    """
    T = T_camera_target[table.view]
    R = T[:, :3, :3]
    still = (R @ table.on_target(shape)[:, :, None])[:, :, 0] + T[:, :3, 3]
    still[:, 2] = np.maximum(still[:, 2], BEHIND)
    X, rate = still, np.zeros_like(still)
    if sweep is not None:
        along = (table.pixels[:, 1] / lens.size[1] - 0.5)[:, None] * sweep[table.view]
        rate = along[:, :3] + np.cross(along[:, 3:], still)
        X = still + readout_s * rate
        X[:, 2] = np.maximum(X[:, 2], BEHIND)
    seen, by_point, by_lens = lens.linearise(X)
    by_point = table.white @ by_point
    by_readout = by_point @ rate[:, :, None]
    if sweep is not None:
        by_point = by_point @ (np.eye(3) + readout_s * so3.hat(along[:, 3:]))
    on = by_point @ R
    by_pose = np.concatenate([by_point, -by_point @ so3.hat(still)], axis=2)
    gap = table.pixels - seen
    by_common = [table.white @ by_lens, on @ table.modes, by_readout]
    by_common += [table.by_places(on)] if len(shape) > SHAPE else []
    white = (table.white @ gap[:, :, None])[:, :, 0]
    return CornerRows(white, by_pose, np.concatenate(by_common, axis=2), gap)


def grams(table: CornerTable, rows: CornerRows) -> Array:
    """For each image the products of its columns with each other, (N, 22 + Z, 22 + Z): pose, common, residual last."""
    columns = np.concatenate([rows.by_pose, rows.by_common, rows.residual[:, :, None]], axis=2)
    columns = columns * np.sqrt(table.weight)[:, None, None]
    out = np.empty((table.views, columns.shape[2], columns.shape[2]))
    for i in range(table.views):
        part = columns[table.of_view(i)].reshape(-1, columns.shape[2])
        out[i] = part.T @ part
    return out


@dataclass(frozen=True)
class CameraState:
    """values (P,): of the arm. offset_s: of the clock. common (15 + Z,): lens, shape, readout, places. kind: a lens."""

    values: Array
    offset_s: float
    common: Array
    kind: Lens

    @cached_property
    def lens(self) -> Lens:
        """As elsewhere."""
        return replace(self.kind, values=self.common[:LENS])

    @property
    def shape(self) -> Array:
        """Of the target, the places of its markers behind it, (5 + Z,)."""
        return shape_of(self.common)

    @property
    def readout_s(self) -> float:
        """In which a rolling shutter goes down an image."""
        return float(self.common[READOUT])

    @property
    def vector(self) -> Array:
        """All values, (P + 16 + Z,): of the arm, the clock's offset, and what images share."""
        return np.r_[self.values, self.offset_s, self.common]

    def at(self, vector: Array) -> CameraState:
        """The state with these values (P + 16 + Z,)."""
        P = len(self.values)
        return CameraState(vector[:P], float(vector[P]), vector[P + 1 :], self.kind)


def shape_of(common: Array) -> Array:
    """Shape of the target with the places of its markers behind it, (5 + Z,), of what images share (15 + Z,)."""
    return np.r_[common[LENS:READOUT], common[COMMON:]]


FREE, TOLERANCE, FIXED = "free", "tolerance", "fixed"  # what becomes of stated intrinsics
# Standard deviations of a lens's values: fx and fy of the focal length, cx and cy of the image's width, distortion. Of
# those that nothing is known of (most fisheyes are within half of that), and of those that a usual calibration states.
_LENS_STD = {
    (PINHOLE, False): np.array([0.5, 0.5, 0.1, 0.1, 0.5, 0.5, 0.01, 0.01, 0.3]),
    (FISHEYE, False): np.array([0.5, 0.5, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1]),
    (PINHOLE, True): np.array([0.005, 0.005, 0.005, 0.005, 0.02, 0.02, 0.001, 0.001, 0.02]),
    (FISHEYE, True): np.array([0.005, 0.005, 0.005, 0.005, 0.02, 0.02, 0.02, 0.02, 0.02]),
}
BOW_M = 3e-4  # of a sheet glued to a board, at its corner; 0.5 mm is common
READOUT_S = 0.02  # of a rolling shutter: an image's rows fill most of the 16 to 33 ms between two; none of a global one
CLOCK_S = 0.05  # of stamps of a camera that nothing synchronises


@dataclass(frozen=True)
class CommonPrior:
    """Expectation of lens, shape, readout and places of markers. mean: (15 + Z,). information: inverse covariance,
    (15 + Z, 15 + Z), places as their tolerances have them. free: (15 + Z,) bool. places: None of a flat sheet.
    """

    mean: Array
    information: Array
    free: np.ndarray
    places: PlacePrior | None = None

    @property
    def shape(self) -> Array:
        """Prior mean of shape and marker places, (5 + Z,)."""
        return shape_of(self.mean)


def common_prior(lens: Lens, target: CalibrationTarget, stated: str | None = None, flat: bool = False) -> CommonPrior:
    """The prior of this lens and target.

    stated: what becomes of the lens's values; None: they are a start, no statement. flat: whether the sheet is known to
    be flat (glass, aluminium).
    """
    width, f = float(lens.size[0]), float(lens.values[:2].mean())
    places = target.place_prior() if isinstance(target, MarkerBundle) else None
    count, scale = COMMON + target.values_of_place * target.marker_count, target.scale
    mean = np.r_[lens.values, scale.x - 1.0, scale.y - 1.0, np.zeros(count - SCALE.stop)]
    if stated not in (TOLERANCE, FIXED):
        mean[2:LENS] = [0.5 * (width - 1.0), 0.5 * (lens.size[1] - 1.0), 0.0, 0.0, 0.0, 0.0, 0.0]
    std = _LENS_STD[lens.model, stated == TOLERANCE] * np.r_[f, f, width, width, np.ones(LENS - 4)]
    information = np.zeros((count, count))
    information[:LENS, :LENS] = np.diag(std**-2)
    information[SCALE, SCALE] = np.linalg.inv(scale.covariance)
    information[BOW, BOW] = np.eye(SHAPE - 2) / BOW_M**2
    information[READOUT, READOUT] = READOUT_S**-2
    if places is not None:
        information[COMMON:, COMMON:] = places.information(1.0)
    free = np.ones(count, bool)
    free[:LENS] = lens.used & (stated != FIXED)
    free[BOW] = not flat and places is None  # a body has no bow
    return CommonPrior(mean, information, free, places)

"""All corners of all images as one table, and the equations of each image: how its corners move with everything.

A corner of an image with the target at T (camera's frame) stands at X = R x + p with x its place on the sheet. A small
twist (a, b) of the target, seen from the camera, moves it by a + b × X; the lens by its own derivative; the sheet's
shape by R dx. A rolling shutter sees each row of the image later than the one above it, so a target that moves by a
twist a second stands elsewhere in each, counted from the middle row, by the share of the image's height. Rows are
whitened by the corners' covariance. What a fit needs of an image is the product of its rows with each other, 22 × 22
however many corners there are, which is why many images stay quick.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.camera.lens import COUNT as LENS
from modcal_core.camera.lens import Lens
from modcal_core.camera.target import PrintedTarget
from modcal_core.camera.views import BoardView, whitening
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array

POSE = 6  # values of a pose
SHAPE_NAMES = ("scale_x", "scale_y", "bow_xx", "bow_xy", "bow_yy")
SHAPE = len(SHAPE_NAMES)  # scale [1], bow at the edge of the sheet [m]
SCALE, BOW = slice(LENS, LENS + 2), slice(LENS + 2, LENS + SHAPE)  # where these stand among what all images share
READOUT = LENS + SHAPE  # the time in which a rolling shutter goes down an image [s]
COMMON = READOUT + 1  # what all images share
BEHIND = 1e-3  # m in front of the camera at least; a corner behind it has no image


@dataclass(frozen=True)
class CornerTable:
    """M corners of N images.

    names: of the images. view: image of each corner, ascending, (M,). ids: (M,). points: on the sheet as stated,
    (M, 3) [m]. bow: how far each leaves the plane per unit of the three modes, (M, 3). pixels: (M, 2). white:
    (M, 2, 2), makes errors white. weight: 1 used, 0 left out, (M,).
    """

    names: tuple[str, ...]
    view: np.ndarray
    ids: np.ndarray
    points: Array
    bow: Array
    pixels: Array
    white: Array
    weight: Array

    @classmethod
    def of(cls, views: Sequence[BoardView], target: PrintedTarget) -> CornerTable:
        """The corners of these views of this target."""
        points = target.points
        middle, half = 0.5 * (points.max(0) + points.min(0)), 0.5 * float(np.linalg.norm(np.ptp(points, axis=0)))
        x, y = ((points - middle)[:, :2] / half).T
        modes = np.stack([x * x, x * y, y * y], axis=1)
        ids = np.concatenate([v.ids for v in views]).astype(int)
        return cls(
            tuple(v.name for v in views),
            np.repeat(np.arange(len(views)), [len(v) for v in views]),
            ids,
            points[ids],
            modes[ids],
            np.concatenate([v.pixels for v in views]),
            whitening(np.concatenate([v.cov for v in views])),
            np.ones(len(ids)),
        )

    def __len__(self) -> int:
        return len(self.view)

    @property
    def views(self) -> int:
        """Number of images."""
        return len(self.names)

    def with_weight(self, weight: Array) -> CornerTable:
        """The same corners, those with weight 0 left out."""
        fields = (self.names, self.view, self.ids, self.points, self.bow, self.pixels, self.white)
        return CornerTable(*fields, weight)

    def select(self, views: np.ndarray) -> CornerTable:
        """The corners of these images (mask (N,)), the images numbered anew."""
        keep = np.flatnonzero(views)
        rows = np.isin(self.view, keep)
        number = np.full(self.views, -1)
        number[keep] = np.arange(len(keep))
        arrays = (self.ids, self.points, self.bow, self.pixels, self.white, self.weight)
        return CornerTable(
            tuple(self.names[i] for i in keep), number[self.view[rows]], *(array[rows] for array in arrays)
        )

    def of_view(self, i: int) -> slice:
        """Rows of an image."""
        first, last = np.searchsorted(self.view, [i, i + 1])
        return slice(int(first), int(last))

    def on_sheet(self, shape: Array) -> Array:
        """Where the corners are on a sheet of this shape (5,), (M, 3) [m]."""
        out = self.points * np.r_[1.0 + shape[:2], 1.0]
        out[:, 2] += self.bow @ shape[2:]
        return out


@dataclass(frozen=True)
class CornerRows:
    """Whitened rows of M corners: residual (M, 2), measured minus predicted, and derivatives of the prediction.

    by_pose: (M, 2, 6), by the twist of the target seen from the camera. by_common: (M, 2, 15), by lens, shape and
    readout.
    pixels: residual in pixels, (M, 2).
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

    readout_s: of a rolling shutter. sweep: twist of the target a second, seen from the camera, (N, 6); None: it stands.
    """
    R, still, X, rate, turned = _in_camera(table, lens, shape, T_camera_target, readout_s, sweep)
    seen, by_point, by_lens = lens.linearise(X)
    by_point = table.white @ by_point
    by_readout = by_point @ rate[:, :, None]
    if turned is not None:
        by_point = by_point @ turned
    on = by_point @ R
    by_pose = np.concatenate([by_point, -by_point @ so3.hat(still)], axis=2)
    by_scale = on[:, :, :2] * table.points[:, None, :2]
    by_bow = on[:, :, 2:] * table.bow[:, None]
    gap = table.pixels - seen
    return CornerRows(
        (table.white @ gap[:, :, None])[:, :, 0],
        by_pose,
        np.concatenate([table.white @ by_lens, by_scale, by_bow, by_readout], axis=2),
        gap,
    )


def residuals(
    table: CornerTable,
    lens: Lens,
    shape: Array,
    T_camera_target: Array,
    readout_s: float = 0.0,
    sweep: Array | None = None,
) -> Array:
    """Residuals in pixels alone, (M, 2), as of :func:`corner_rows`."""
    X = _in_camera(table, lens, shape, T_camera_target, readout_s, sweep)[2]
    return table.pixels - lens.project(X)


def _in_camera(
    table: CornerTable, lens: Lens, shape: Array, T_camera_target: Array, readout_s: float, sweep: Array | None
) -> tuple[Array, Array, Array, Array, Array | None]:
    """(rotation of the target (M, 3, 3), corners in the camera's frame (M, 3) when the middle row was read and when
    their own was, their motion per readout (M, 3), derivative of the second by the first (M, 3, 3), None for 1).
    """
    T = T_camera_target[table.view]
    R = T[:, :3, :3]
    X = (R @ table.on_sheet(shape)[:, :, None])[:, :, 0] + T[:, :3, 3]
    X[:, 2] = np.maximum(X[:, 2], BEHIND)
    if sweep is None:
        return R, X, X, np.zeros_like(X), None
    down = table.pixels[:, 1] / lens.size[1] - 0.5
    along = down[:, None] * sweep[table.view]
    rate = along[:, :3] + np.cross(along[:, 3:], X)
    moved = X + readout_s * rate
    moved[:, 2] = np.maximum(moved[:, 2], BEHIND)
    return R, X, moved, rate, np.eye(3) + readout_s * so3.hat(along[:, 3:])


def grams(table: CornerTable, rows: CornerRows) -> Array:
    """For each image the products of its columns with each other, (N, 22, 22): pose, common, residual last."""
    columns = np.concatenate([rows.by_pose, rows.by_common, rows.residual[:, :, None]], axis=2)
    columns = columns * np.sqrt(table.weight)[:, None, None]
    out = np.empty((table.views, columns.shape[2], columns.shape[2]))
    for i in range(table.views):
        part = columns[table.of_view(i)].reshape(-1, columns.shape[2])
        out[i] = part.T @ part
    return out

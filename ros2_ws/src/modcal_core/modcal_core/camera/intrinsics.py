"""Lens and poses of the target from images alone: a start in closed form, then least squares over all corners.

Poses are eliminated image by image (Schur complement), so that the step is solved for the lens only. No prior: the
minimum is that of any other program on the same corners.

The focal length begins as homographies of all images have it (Zhang 2000), the principal point in the middle of the
image. Points that are flat, or nearly, look much the same tilted the other way about the line of sight, so that every
image has two poses.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from modcal_core.camera.corners import POSE, SHAPE, CornerTable, corner_rows, grams, images_with_pose
from modcal_core.camera.lens import COUNT, FISHEYE, PINHOLE, Lens
from modcal_core.errors import NotEnoughData
from modcal_core.geometry import Array, descend, se3, so3

_FLAT = np.zeros(SHAPE)
_STEPS, _MET = 12, 1e-9  # of poses: they meet in four to six; m, rad: a step below changes nothing


@dataclass(frozen=True)
class BoardPose:
    """Two poses of the target in each of N images. T: T_camera_target, the better one first, (N, 2, 4, 4) [m].

    cost: sum of whitened squares, (N, 2). rms: of the better one [px], (N,).
    """

    T: Array
    cost: Array
    rms: Array


def board_poses(table: CornerTable, lens: Lens, shape: Array = _FLAT) -> BoardPose:
    """Both poses of the target in every image, which must show four corners at least. shape: (5,)."""
    import cv2

    start = np.empty((2, table.views, 4, 4))
    for i in range(table.views):
        rows = table.of_view(i)
        points, rays = table.points[rows], lens.rays(table.pixels[rows])[:, None]
        first = se3.exp(np.r_[0.0, 0.0, 1.0, np.zeros(3)])
        with suppress(cv2.error):  # of points on one line
            _, turn, place, _ = cv2.solvePnPGeneric(points, rays, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
            first = se3.transform(so3.exp(turn[0].ravel()), place[0].ravel()) if len(turn) else first
        start[0, i], start[1, i] = first, _twin(first, points)
    T, cost = (np.stack(part, axis=1) for part in zip(*(_refined(table, lens, shape, s) for s in start), strict=True))
    order = np.argsort(cost, axis=1)
    T, cost = np.take_along_axis(T, order[:, :, None, None], axis=1), np.take_along_axis(cost, order, axis=1)
    square = table.weight * (corner_rows(table, lens, shape, T[:, 0]).pixels ** 2).sum(axis=1)
    square, weight = (np.bincount(table.view, part, table.views) for part in (square, table.weight))
    return BoardPose(T, cost, np.sqrt(square / np.maximum(weight, 1.0)))


def _twin(T: Array, points: Array) -> Array:
    """The pose in which the plane nearest to points (m, 3) is tilted the other way about the line of sight."""
    middle = points.mean(axis=0)
    normal, seen = T[:3, :3] @ np.linalg.svd(points - middle)[2][2], se3.apply(T, middle)
    sight = seen / np.linalg.norm(seen)
    normal *= np.sign(normal @ sight)
    axis = np.cross(normal, sight)
    sine = float(np.linalg.norm(axis))
    R = so3.exp(2.0 * np.arctan2(sine, float(normal @ sight)) * axis / max(sine, 1e-12)) @ T[:3, :3]
    return se3.transform(R, seen - R @ middle)


def _refined(table: CornerTable, lens: Lens, shape: Array, T: Array) -> tuple[Array, Array]:
    """(poses (N, 4, 4), cost (N,)) by damped Gauss-Newton steps of all images at once."""
    damping = np.full(table.views, 1e-6)
    G = grams(table, corner_rows(table, lens, shape, T))
    for _ in range(_STEPS):
        H = G[:, :POSE, :POSE]
        more = damping[:, None] * np.einsum("nii->ni", H) + 1e-12
        step = np.linalg.solve(H + more[:, :, None] * np.eye(POSE), G[:, :POSE, -1:])[:, :, 0]
        moved = se3.exp(np.clip(step, -0.5, 0.5)) @ T
        new = grams(table, corner_rows(table, lens, shape, moved))
        better = new[:, -1, -1] <= G[:, -1, -1]
        T, G = (np.where(better[:, None, None], a, b) for a, b in ((moved, T), (new, G)))
        damping = np.where(better, np.maximum(0.1 * damping, 1e-9), np.minimum(10.0 * damping + 1e-3, 1e6))
        if np.abs(step[better]).max(initial=0.0) < _MET:
            break
    return T, G[:, -1, -1]


_INTRINSICS_STEPS = 100  # of Gauss and Newton, at most
_INTRINSICS_MET = 1e-12  # relative gain of the cost
_LONGEST = 10.0  # times the image's size, of a focal length; images square on show longer ones
_FOCALS = np.geomspace(0.4, 6.0, 17)  # times the image's width: lenses of 100° to 10°
_HALF_ANGLES = np.radians(np.linspace(35.0, 95.0, 13))  # of fisheyes, from the middle to the farther edge


@dataclass(frozen=True)
class LensFit:
    """A lens and the target's pose in each image, T_camera_target (N, 4, 4) [m]. grams: products of the columns of each
    image, (N, 22, 22). cost: sum of whitened squares.
    """

    lens: Lens
    T_camera_target: Array
    grams: Array
    cost: float


def plain_lenses(size: tuple[int, int], model: str) -> list[Lens]:
    """Lenses without distortion of all usual angles of view."""
    focal = 0.5 / _HALF_ANGLES if model == FISHEYE else _FOCALS
    return [Lens.plain(max(size) * f, size, model) for f in focal.tolist()]


def first_lens(table: CornerTable, size: tuple[int, int], model: str = PINHOLE) -> Lens:
    """A lens without distortion to begin with: of a pinhole from the homographies of all images, of a fisheye the one
    of some angles of view that meets the images best. Raises NotEnoughData.
    """
    import cv2

    if model == FISHEYE:
        return min(plain_lenses(size, FISHEYE), key=lambda lens: float(np.median(board_poses(table, lens).rms)))
    rows = [table.of_view(int(i)) for i in np.flatnonzero(images_with_pose(table))]
    points, pixels = ([part[own].astype(np.float32) for own in rows] for part in (table.points, table.pixels))
    focal = float(cv2.initCameraMatrix2D(points, pixels, size, 1.0)[0, 0]) if rows else np.inf
    if not 0.0 < focal < _LONGEST * max(size):
        said = "the images do not show the focal length"
        raise NotEnoughData("camera", said, "tilt the target by 20° to 45° to several sides, or state the intrinsics")
    return Lens.plain(focal, size)


def fit_lens(table: CornerTable, start: Lens, free: np.ndarray | None = None, prior: Array | None = None) -> LensFit:
    """The lens, from this start, and poses with least squares over all corners.

    free: which of its nine values to fit, (9,) bool; None: all. prior: information (9, 9) about the start; None: none.
    """
    use = np.flatnonzero(start.used if free is None else free & start.used)
    P0 = np.zeros((len(use), len(use))) if prior is None else prior[np.ix_(use, use)]
    p, c = slice(0, POSE), POSE + use

    def at(lens: Lens, T: Array) -> LensFit:
        G = grams(table, corner_rows(table, lens, _FLAT, T))
        off = (lens.values - start.values)[use]
        return LensFit(lens, T, G, float(G[:, -1, -1].sum() + off @ P0 @ off))

    def stepped(here: LensFit, damping: float) -> tuple[LensFit, float] | None:
        G = here.grams
        Hpp = G[:, p, p] * (1.0 + damping * np.eye(POSE))
        Hpp = Hpp + (np.einsum("nii->n", Hpp) == 0.0)[:, None, None] * np.eye(POSE)  # all corners left out: any pose
        Hcp = G[:, c, p]
        back = np.linalg.solve(Hpp, np.concatenate([np.swapaxes(Hcp, 1, 2), G[:, p, -1:]], axis=2))
        H = (G[:, c[:, None], c]).sum(0) - (Hcp @ back[:, :, :-1]).sum(0) + P0
        g = (G[:, c, -1] - (Hcp @ back[:, :, -1:])[:, :, 0]).sum(0) - P0 @ (here.lens.values - start.values)[use]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        change = np.zeros(COUNT)
        change[use] = scale * np.linalg.solve(H * np.outer(scale, scale) + damping * np.eye(len(use)), scale * g)
        lens, moves = here.lens.moved(change), back[:, :, -1] - back[:, :, :-1] @ change[use]
        if lens.values[:2].min() <= 0.0:
            return None
        there = at(lens, se3.exp(moves) @ here.T_camera_target)
        return there, there.cost

    begin = at(start, board_poses(table, start).T[:, 0])
    return descend(
        begin, lambda fit: fit.cost, stepped, lambda _, gain, cost: gain <= _INTRINSICS_MET * cost, _INTRINSICS_STEPS
    ).place

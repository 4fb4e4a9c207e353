"""Where a body is in single images: of its points in three dimensions, which need not lie in a plane.

Points in depth begin with the affine camera that meets their rays (scaled orthographic projection, DeMenthon and Davis
1995), points of one face with the homography of their plane; both are tried with the twin that is tilted the other way
about the line of sight, for shallow points have one as sheets do, and refined.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modcal_core.camera.corners import CornerTable
from modcal_core.camera.homography import homography
from modcal_core.camera.lens import Lens
from modcal_core.camera.pnp import BoardPose, pose_of_plane, refined_poses, twin_pose
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array

MIN_POINTS = 4  # of an image, of which a pose is taken: three leave four poses
_FLAT = 0.15  # depth of points over their width, below which they are begun with as a plane
_LINE = 0.05  # width of points over their length, below which they are a line


def images_with_pose(table: CornerTable) -> np.ndarray:
    """Images (N,) whose points show a pose by themselves."""
    return np.array([_plane(_of_view(table, i)) is not None for i in range(table.views)], dtype=bool)


def body_poses(table: CornerTable, lens: Lens) -> BoardPose:
    """Both poses of the body, as stated, in every image, each of which must show one (:func:`images_with_pose`)."""
    table = replace(table, places=0, markers=0)  # all in their places, whose derivatives take time
    N = table.views
    start = np.empty((2, N, 4, 4))
    for i in range(N):
        rows = np.flatnonzero((table.view == i) & (table.weight > 0.0))
        points, rays = table.points[rows], lens.rays(table.pixels[rows])
        found = _plane(points)
        assert found is not None
        T_body_plane, flat = found
        at_plane = se3.apply(se3.inverse(T_body_plane), points)
        first = pose_of_plane(homography(at_plane[:, :2], rays)) if flat else _by_affine(at_plane, rays)
        start[0, i] = first @ se3.inverse(T_body_plane)
        start[1, i] = twin_pose(first, np.zeros(3)) @ se3.inverse(T_body_plane)
    T, cost, rms = (np.stack(part, axis=1) for part in zip(*(_refined(table, lens, s) for s in start), strict=True))
    order = np.argsort(cost, axis=1)
    return BoardPose(
        np.take_along_axis(T, order[:, :, None, None], axis=1),
        np.take_along_axis(cost, order, axis=1),
        np.take_along_axis(rms, order, axis=1)[:, 0],
    )


def _refined(table: CornerTable, lens: Lens, start: Array) -> tuple[Array, Array, Array]:
    return refined_poses(table, lens, table.unshaped, start)


def _of_view(table: CornerTable, view: int) -> Array:
    rows = table.of_view(view)
    return table.points[rows][table.weight[rows] > 0.0]


def _plane(points: Array) -> tuple[Array, bool] | None:
    """(pose of the plane that is nearest to points (m, 3), origin in their middle, whether they lie in it), None for
    points that show no pose.
    """
    if len(points) < MIN_POINTS:
        return None
    middle = points.mean(axis=0)
    _, spread, axes = np.linalg.svd(points - middle)
    if spread[1] < _LINE * spread[0]:
        return None
    axes[2] *= np.sign(np.linalg.det(axes))
    return se3.transform(axes.T, middle), bool(spread[2] < _FLAT * spread[1])


def _by_affine(points: Array, rays: Array) -> Array:
    """The pose of points (m, 3) about their middle that parallel projection to rays x, y (m, 2) shows."""
    middle = rays.mean(axis=0)
    a, b = np.linalg.lstsq(points, rays - middle, rcond=None)[0].T
    depth = 1.0 / max(float(np.sqrt(np.linalg.norm(a) * np.linalg.norm(b))), 1e-9)
    a, b = a / max(float(np.linalg.norm(a)), 1e-12), b / max(float(np.linalg.norm(b)), 1e-12)
    R = so3.nearest_rotation(np.stack([a, b, np.cross(a, b)]))
    return se3.transform(R, depth * np.r_[middle, 1.0])

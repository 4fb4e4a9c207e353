"""Where the target is in one image: two poses, because a flat sheet seen from afar has a twin that is tilted the other
way, each refined, the better one first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.camera.corners import CornerTable, corner_rows
from modcal_core.camera.homography import homography
from modcal_core.camera.lens import Lens
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array

_STEPS = 12  # of Gauss and Newton's method: it has met in four to six from a homography
_MET = 1e-9  # m, rad; a step below changes nothing


@dataclass(frozen=True)
class BoardPose:
    """Two poses of the target in each of N images. T: T_camera_target, the better one first, (N, 2, 4, 4) [m].

    cost: sum of whitened squares, (N, 2). rms: of the better one [px], (N,).
    """

    T: Array
    cost: Array
    rms: Array


def board_poses(table: CornerTable, lens: Lens, shape: Array) -> BoardPose:
    """Both poses of the target in every image, which must show four corners at least."""
    N = table.views
    start = np.empty((2, N, 4, 4))
    for i in range(N):
        rows = table.of_view(i)
        first = pose_of_plane(homography(table.points[rows, :2], lens.rays(table.pixels[rows])))
        start[0, i] = first
        start[1, i] = twin_pose(first, table.points[rows].mean(axis=0))
    T, cost, rms = zip(*(refined_poses(table, lens, shape, s) for s in start), strict=True)
    order = np.argsort(np.stack(cost, axis=1), axis=1)
    T_both = np.take_along_axis(np.stack(T, axis=1), order[:, :, None, None], axis=1)
    both_rms = np.take_along_axis(np.stack(rms, axis=1), order, axis=1)
    return BoardPose(T_both, np.take_along_axis(np.stack(cost, axis=1), order, axis=1), both_rms[:, 0])


def pose_of_plane(H: Array) -> Array:
    """The pose of a plane whose x, y, 1 this takes to rays x, y, 1 (Zhang 2000)."""
    scale = 2.0 / (np.linalg.norm(H[:, 0]) + np.linalg.norm(H[:, 1]))
    a, b, t = (scale * H).T
    return se3.transform(so3.nearest_rotation(np.stack([a, b, np.cross(a, b)], axis=1)), t)


def twin_pose(T: Array, centre: Array) -> Array:
    """The pose tilted the other way about the line of sight to the sheet's centre, which stays where it is."""
    seen = T[:3, :3] @ centre + T[:3, 3]
    sight = seen / np.linalg.norm(seen)
    normal = T[:3, 2] * np.sign(T[:3, 2] @ sight)
    axis = np.cross(normal, sight)
    sine = float(np.linalg.norm(axis))
    turn = 2.0 * np.arctan2(sine, float(normal @ sight)) * axis / max(sine, 1e-12)
    R = so3.exp(turn) @ T[:3, :3]
    return se3.transform(R, seen - R @ centre)


def refined_poses(table: CornerTable, lens: Lens, shape: Array, T: Array) -> tuple[Array, Array, Array]:
    """(poses (N, 4, 4), cost (N,), RMS [px] (N,)) by damped Gauss-Newton steps of all images at once."""
    damping = np.full(table.views, 1e-6)
    cost, H, g, rms = _normal(table, lens, shape, T)
    for _ in range(_STEPS):
        damped = H + (damping[:, None] * np.einsum("nii->ni", H))[:, :, None] * np.eye(6)
        step = np.linalg.solve(damped + 1e-12 * np.eye(6), g[:, :, None])[:, :, 0]
        moved = se3.exp(np.clip(step, -0.5, 0.5)) @ T
        new = _normal(table, lens, shape, moved)
        better = new[0] <= cost
        T = np.where(better[:, None, None], moved, T)
        cost, H, g, rms = (
            np.where(better.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in zip(new, (cost, H, g, rms), strict=True)
        )
        damping = np.where(better, np.maximum(0.1 * damping, 1e-9), np.minimum(10.0 * damping + 1e-3, 1e6))
        if np.abs(step[better]).max(initial=0.0) < _MET:
            break
    return T, cost, rms


def _normal(table: CornerTable, lens: Lens, shape: Array, T: Array) -> tuple[Array, Array, Array, Array]:
    rows = corner_rows(table, lens, shape, T)
    w = table.weight

    def of_views(values: Array) -> Array:
        out = np.zeros((table.views, *values.shape[1:]))
        np.add.at(out, table.view, values)
        return out

    square = of_views(w * np.einsum("mi,mi->m", rows.residual, rows.residual))
    H = of_views(w[:, None, None] * np.einsum("mki,mkj->mij", rows.by_pose, rows.by_pose))
    g = of_views(w[:, None] * np.einsum("mki,mk->mi", rows.by_pose, rows.residual))
    px = of_views(w * np.einsum("mi,mi->m", rows.pixels, rows.pixels))
    return square, H, g, np.sqrt(px / np.maximum(of_views(w), 1.0))

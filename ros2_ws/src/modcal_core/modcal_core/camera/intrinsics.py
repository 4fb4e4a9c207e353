"""The lens from images alone, the target anywhere in each of them: least squares over lens and poses together.

Poses are eliminated image by image (Schur complement), so that the step is solved for the lens only. No prior: the
minimum is that of any other program on the same corners.

A homography H takes the sheet's x, y, 1 to pixels (direct linear transform, Hartley's scaling). Its first two columns
are images of two unit vectors at right angles, which gives two equations for the focal lengths (Zhang 2000), the
principal point being taken to be the middle of the image until the fit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from modcal_core.camera.corners import POSE, SHAPE, CornerTable, corner_rows, grams
from modcal_core.camera.lens import COUNT, FISHEYE, PINHOLE, Lens
from modcal_core.errors import NotEnoughData
from modcal_core.geometry import Array, se3, so3

_MIN_TILT = 1e-3  # of the equations; below, all images show the sheet square on


def projection(at: Array, pixels: Array) -> Array:
    """The matrix (3, k), to a factor, that takes places (m, k), homogeneous, to pixels (m, 2) (direct linear
    transform).
    """
    zero = np.zeros_like(at)
    rows = np.r_[np.c_[at, zero, -pixels[:, :1] * at], np.c_[zero, at, -pixels[:, 1:] * at]]
    few = len(rows) < rows.shape[1]  # four corners leave one direction that no row is along
    return np.asarray(np.linalg.svd(rows, full_matrices=few)[2][-1].reshape(3, -1))


def homography(points: Array, pixels: Array) -> Array:
    """H (3, 3) that takes points (m, 2) of a plane to pixels (m, 2), m ≥ 4; its last element is positive."""
    A, a = _scaled(points)
    B, b = _scaled(pixels)
    H = np.linalg.inv(B) @ projection(np.c_[a, np.ones(len(a))], b) @ A
    centre = np.r_[points.mean(0), 1.0]
    return np.asarray(H * np.sign(H[2] @ centre) / np.linalg.norm(H))


def lens_of_homographies(found: Sequence[Array], size: tuple[int, int]) -> Lens:
    """The lens without distortion, principal point in the middle, that these homographies (3, 3) are images of.

    Raises NotEnoughData where they do not tell its focal lengths.
    """
    cx, cy = 0.5 * (size[0] - 1), 0.5 * (size[1] - 1)
    middle = np.array([[1.0, 0.0, -cx], [0.0, 1.0, -cy], [0.0, 0.0, 1.0]])
    scale = np.diag([1.0 / max(size), 1.0 / max(size), 1.0])
    rows, right = [], []
    for H in found:
        h = scale @ middle @ H
        h = h / np.sqrt(np.linalg.norm(h[:, 0]) * np.linalg.norm(h[:, 1]))
        d1, d2 = h[:, 0] + h[:, 1], h[:, 0] - h[:, 1]
        rows += [h[:2, 0] * h[:2, 1], 0.5 * d1[:2] * d2[:2]]
        right += [-h[2, 0] * h[2, 1], -0.5 * d1[2] * d2[2]]
    A, b = np.array(rows), np.array(right)
    inverse_squares = np.linalg.lstsq(A, b, rcond=None)[0] if len(A) else np.zeros(2)
    if np.abs(b).max(initial=0.0) < _MIN_TILT or not (inverse_squares > 1e-4).all():
        # one focal length for both, which is what nearly every camera has
        both = A.sum(axis=1)
        one = float(both @ b / max(both @ both, 1e-300)) if len(A) else 0.0
        inverse_squares = np.array([one, one])
    if not (inverse_squares > 1e-4).all():
        said = "the images do not show the focal length"
        raise NotEnoughData("camera", said, "tilt the target by 20° to 45° to several sides, or state the intrinsics")
    f = max(size) / np.sqrt(inverse_squares)
    return Lens(np.r_[f, cx, cy, np.zeros(5)], size)


def _scaled(points: Array) -> tuple[Array, Array]:
    """(transform (3, 3), points (m, 2)) with mean zero and mean distance √2 (Hartley 1997)."""
    centre = points.mean(axis=0)
    s = np.sqrt(2.0) / max(float(np.linalg.norm(points - centre, axis=1).mean()), 1e-300)
    return np.array([[s, 0.0, -s * centre[0]], [0.0, s, -s * centre[1]], [0.0, 0.0, 1.0]]), s * (points - centre)


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
    return both_poses(table, lens, shape, start)


def both_poses(table: CornerTable, lens: Lens, shape: Array, start: Array) -> BoardPose:
    """Both poses of the target in every image from these, (2, N, 4, 4), refined, the better one first."""
    every = zip(*(refined_poses(table, lens, shape, s) for s in start), strict=True)
    T, cost, rms = (np.stack(part, axis=1) for part in every)
    order = np.argsort(cost, axis=1)
    return BoardPose(
        np.take_along_axis(T, order[:, :, None, None], axis=1),
        np.take_along_axis(cost, order, axis=1),
        np.take_along_axis(rms, order, axis=1)[:, 0],
    )


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


_FIRST, _LEAST, _MOST = 1e-6, 1e-12, 1e7  # damping, relative to the curvature of each value; at the last no step helps


class Descending(Protocol):
    """Where a descent stands."""

    @property
    def cost(self) -> float:
        """Of the place."""


_P = TypeVar("_P", bound=Descending)


def damped(
    here: _P, stepped: Callable[[_P, float], _P | None], met: float, share: float, steps: int
) -> tuple[_P, bool]:
    """(the place where the cost is least, whether it met) by damped Gauss-Newton steps from here.

    stepped: the place a step with this damping farther, None for one that is not possible. met, share: gain of the last
    step, absolute and relative to the cost. steps: at most.
    """
    damping = _FIRST
    for _ in range(steps):
        there = stepped(here, damping)
        if there is not None and there.cost <= here.cost + met:
            gain, here = here.cost - there.cost, there
            damping = max(0.1 * damping, _LEAST)
            if gain <= met + share * max(here.cost, 1e-30):
                return here, True
        else:
            damping = max(10.0 * damping, _FIRST)
            if damping > _MOST:
                return here, True
    return here, False


_INTRINSICS_STEPS = 100  # of Gauss and Newton, at most
_INTRINSICS_MET = 1e-12  # relative gain of the cost
_FLAT = np.zeros(SHAPE)
_HALF_ANGLES = np.radians([35.0, 45.0, 55.0, 65.0, 80.0, 95.0])  # of fisheyes, from the middle to the farther edge
_MANY, _MIN = 8, 3  # corners of an image that shows perspective well, and images of that kind that are enough


@dataclass(frozen=True)
class LensFit:
    """A lens and the target's pose in each image, T_camera_target (N, 4, 4) [m]. cost: sum of whitened squares.

    rms: [px]. cov: of the lens's values, (9, 9), rows and columns of those held fixed zero. converged: whether it met.
    """

    lens: Lens
    T_camera_target: Array
    cost: float
    rms: float
    cov: Array
    converged: bool


@dataclass(frozen=True)
class _LensAt:
    """A lens, poses, the products of the columns of their images, and the cost."""

    lens: Lens
    T: Array
    G: Array
    cost: float


def first_lens(table: CornerTable, size: tuple[int, int], model: str = PINHOLE) -> Lens:
    """A lens to begin with: of a pinhole from the homographies of all images, of a fisheye the one of some angles of
    view that meets the images best. Raises NotEnoughData.
    """
    if model == FISHEYE:
        tried = [Lens.plain(0.5 * max(size) / angle, size, FISHEYE) for angle in _HALF_ANGLES]
        return min(tried, key=lambda lens: float(np.median(board_poses(table, lens, _FLAT).rms)))
    counts = np.bincount(table.view, minlength=table.views)
    many = np.flatnonzero(counts >= _MANY)
    found = []
    for i in many if len(many) >= _MIN else range(table.views):
        rows = table.of_view(int(i))
        found.append(homography(table.points[rows, :2], table.pixels[rows]))
    return lens_of_homographies(found, size)


def fit_lens(table: CornerTable, start: Lens, free: np.ndarray | None = None, prior: Array | None = None) -> LensFit:
    """The lens, from this start, and poses with least squares over all corners.

    free: which of its nine values to fit, (9,) bool; None: all. prior: information (9, 9) about the start; None: none.
    """
    use = np.flatnonzero(start.used if free is None else free & start.used)
    P0 = np.zeros((len(use), len(use))) if prior is None else prior[np.ix_(use, use)]
    p, c = slice(0, POSE), POSE + use

    def at(lens: Lens, T: Array) -> _LensAt:
        G = grams(table, corner_rows(table, lens, _FLAT, T))
        off = (lens.values - start.values)[use]
        return _LensAt(lens, T, G, float(G[:, -1, -1].sum() + off @ P0 @ off))

    def stepped(here: _LensAt, damping: float) -> _LensAt | None:
        G = here.G
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
        return at(lens, se3.exp(moves) @ here.T) if lens.values[:2].min() > 0.0 else None

    begin = at(start, board_poses(table, start, _FLAT).T[:, 0])
    found, converged = damped(begin, stepped, 0.0, _INTRINSICS_MET, _INTRINSICS_STEPS)
    lens, T, G = found.lens, found.T, found.G
    cov = np.zeros((COUNT, COUNT))
    across = G[:, c, :POSE]  # undamped, the poses taken out
    taken = across @ np.linalg.pinv(G[:, :POSE, :POSE], hermitian=True) @ np.swapaxes(across, 1, 2)
    information = (G[:, c[:, None], c] - taken).sum(0)
    cov[np.ix_(use, use)] = np.linalg.pinv(information + P0, hermitian=True)
    rms = table.rms(corner_rows(table, lens, _FLAT, T).pixels)
    return LensFit(lens, T, found.cost, rms, cov, converged)

"""Lens, camera and body to begin with, from all images of a body and the flange poses at which they were taken.

A body is small beside its distance, and its markers are not where they are drawn, so single images hardly tell the
focal length; the arm's motion does. The sightings of single points from all postures show camera, lens and body
together; where they are too few, the focal length is taken at which the body's poses by single images meet the flange's
best. Of what is found either way, the one counts that corners are nearer to.

Points in depth begin with the affine camera that meets their rays (scaled orthographic projection, DeMenthon and Davis
1995), points of one face with the homography of their plane; both are tried with the twin that is tilted the other way
about the line of sight, for shallow points have one as sheets do, and refined.

Where single images have too few points for a pose, the points are seen from many postures. One that stands at y on the
tip is seen, up to a factor, at P A ỹ, with A the flange pose and P the camera's matrix in the base. That is linear in
the products of P's and y's elements, 39 of them, which the sightings of one point show to a factor; their 9 × 4 part
has rank one, which parts y from P. Then P by all points, and each point by P, in turn, and the body is laid into its
points (Kabsch). With the flange's inverse it is the same for a camera on the tip and a body in the world.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import procrustes
from modcal_core.camera.bundle import MARKER_CORNERS, MarkerBundle
from modcal_core.camera.corners import CornerTable, corner_rows
from modcal_core.camera.intrinsics import BoardPose, both_poses, homography, pose_of_plane, projection, twin_pose
from modcal_core.camera.lens import FISHEYE, Lens
from modcal_core.camera.mounting import MIN_VIEWS, Mounting, find_mounting, mounting_misfit, relative_turns
from modcal_core.errors import BadTable, ModcalError, NotEnoughData
from modcal_core.geometry import Array, se3, so3

_SIGHTINGS = 25  # of one point, for the 38 ratios in their products: two of each, and some to spare
_MIN = 12  # of all points, for a camera's 11 numbers twice over
_MAX = 2000  # sightings, for time; the others come into the fit
_TRIED = 4  # points that are begun with, those seen most often
_ROUNDS = 100  # of camera and points in turn
_OUTLIER = 5.0  # times the median, beyond which a sighting does not count
_MIN_POINTS = 3  # that the body is laid into


@dataclass(frozen=True)
class Resection:
    """focal: of rays as given, 1 where these are known. T_camera_base, T_tip_body: (4, 4) [m]. miss: median distance of
    rays from where they should be, relative to ``focal``.
    """

    focal: float
    T_camera_base: Array
    T_tip_body: Array
    miss: float


def resection(A: Array, point: np.ndarray, rays: Array, body: Array, calibrated: bool) -> Resection | None:
    """Camera and body from sightings of points, None where these are too few.

    A: flange pose at each sighting, (M, 4, 4) [m]. point: which is seen, (M,). rays: where, x and y at depth 1, or,
    unless calibrated, in any unit from the image's middle, (M, 2). body: the nominal points, (C, 3) [m].
    """
    if len(A) > _MAX:
        some = np.linspace(0, len(A) - 1, _MAX).astype(int)
        A, point, rays = A[some], point[some], rays[some]
    counts = np.bincount(point, minlength=len(body))
    begin = [_matrix(A[:, :, 3], rays)]  # a body about the flange
    for first in np.argsort(-counts)[:_TRIED]:
        if counts[first] >= _SIGHTINGS:
            rows = point == first
            begin.append(_lifted(A[rows], rays[rows]))
    best: tuple[float, Array, Array] | None = None
    for P in begin:
        found = _in_turn(P, A, point, rays, len(body))
        if found is not None and (best is None or found[0] < best[0]):
            best = found
    if best is None:
        return None
    miss, P, y = best
    seen = np.flatnonzero(np.isfinite(y).all(axis=1))
    if len(seen) < _MIN_POINTS:
        return None
    focal, T = _camera_of(P, calibrated)
    return Resection(focal, T, procrustes(body[seen], y[seen]), miss / focal)


def _lifted(A: Array, rays: Array) -> Array:
    """The camera's matrix (3, 4) by sightings of one point."""
    M = len(A)
    phi = np.concatenate([A[:, :3, :3].reshape(M, 9), A[:, :3, 3], np.ones((M, 1))], axis=1)
    scale = 1.0 / np.maximum(np.linalg.norm(phi, axis=0), 1e-300)
    w = scale * projection(phi * scale, rays)
    products = np.concatenate([w[:, :9].reshape(9, 3), w[:, 9:12].reshape(9, 1)], axis=1)
    U, s, Vt = np.linalg.svd(products, full_matrices=False)
    left = (U[:, 0] * s[0] * Vt[0, 3]).reshape(3, 3)
    return np.c_[left, w[:, 12]]


def _in_turn(P: Array, A: Array, point: np.ndarray, rays: Array, count: int) -> tuple[float, Array, Array] | None:
    """(median miss, P, points (count, 3), NaN of those not seen twice)."""
    use = np.ones(len(A), bool)
    miss, y = np.inf, np.full((count, 3), np.nan)
    for _ in range(_ROUNDS):
        y = _points(P, A, point, rays, use, count)
        known = use & np.isfinite(y[point]).all(axis=1)
        if known.sum() < _MIN:
            return None
        at = (A[known] @ np.c_[y[point[known]], np.ones(known.sum())][:, :, None])[:, :, 0]
        P = _matrix(at, rays[known])
        gap = _miss(P, A, point, rays, y)
        new = float(np.nanmedian(gap))
        use = gap <= _OUTLIER * new
        if abs(miss - new) < 1e-4 * new:
            break
        miss = new
    return new, P, y


def _points(P: Array, A: Array, point: np.ndarray, rays: Array, use: np.ndarray, count: int) -> Array:
    """Each point from its sightings by a known camera."""
    PA = P @ A
    rows = PA[:, :2] - rays[:, :, None] * PA[:, 2:]  # times (y, 1) it is zero
    out = np.full((count, 3), np.nan)
    for k in range(count):
        own = rows[use & (point == k)].reshape(-1, 4)
        if len(own) >= 4:
            out[k] = np.linalg.lstsq(own[:, :3], -own[:, 3], rcond=None)[0]
    return out


def _matrix(at: Array, rays: Array) -> Array:
    """The camera's matrix by places (M, 4), homogeneous, and rays (M, 2) (direct linear transform)."""
    centre, size = at[:, :3].mean(axis=0), float(np.abs(at[:, :3] - at[:, :3].mean(axis=0)).mean())
    to_unit = np.diag([1.0 / size] * 3 + [1.0])
    to_unit[:3, 3] = -centre / size
    unit = at @ to_unit.T
    return np.asarray(projection(unit, rays) @ to_unit)


def _miss(P: Array, A: Array, point: np.ndarray, rays: Array, y: Array) -> Array:
    seen = (P @ A @ np.c_[y[point], np.ones(len(point))][:, :, None])[:, :, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.linalg.norm(seen[:, :2] / seen[:, 2:] - rays, axis=1))


def _camera_of(P: Array, calibrated: bool) -> tuple[float, Array]:
    """(focal length, T_camera_base) of a matrix with square pixels about the image's middle."""
    sign = np.sign(np.linalg.det(P[:, :3]))  # it is known to a factor, and so is its sign
    left, t = sign * P[:, :3], sign * P[:, 3]
    unit = np.linalg.norm(left[2])
    left, t = left / unit, t / unit
    axis = left[2]
    across = left[:2] - (left[:2] @ axis)[:, None] * axis  # what is along it is the centre's, taken to be the middle
    focal = 1.0 if calibrated else float(np.linalg.norm(across, axis=1).mean())
    inverse = np.diag([1.0 / focal, 1.0 / focal, 1.0])
    R = so3.nearest_rotation(inverse @ left)
    return focal, se3.transform(R, inverse @ t)


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
    return both_poses(table, lens, table.unshaped, start)


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


_ENOUGH = 8  # images with a pose: twice as many as a mounting needs, so that a misread one is outvoted
_LOOKED_AT = 30  # of these, for time, while the focal length is looked for
_FOCALS = np.geomspace(0.4, 6.0, 17)  # times the image's width: lenses of 100° to 10°
_HALF_ANGLES = np.radians(np.linspace(35.0, 95.0, 13))  # of fisheyes, from the middle to the farther edge
_FINER = np.linspace(0.85, 1.18, 9)  # between one of these and the next
_CLEAR = 2.0  # ratio of the misfits of both mountings, as with poses, and of two orders of corners


@dataclass(frozen=True)
class BodyStart:
    """lens, mounting: to begin with. T_camera_target: of the mounting is by the arm, in every image."""

    lens: Lens
    mounting: Mounting

    def miss_px(self, table: CornerTable) -> float:
        """Median distance of corners from where they should be [px]."""
        off = corner_rows(table, self.lens, table.unshaped, self.mounting.T_camera_target).pixels
        return float(np.median(np.linalg.norm(off, axis=1)))


def start_of_body(table: CornerTable, A: Array, lens: Lens | None, usual: Lens, on_tip: bool | None) -> BodyStart:
    """The start of images (N) of a body.

    A: flange poses, (N, 4, 4) [m]. lens: as stated, None where it is to be found. usual: of its model and image size.
    on_tip: the mounting where it is stated. Raises ModcalError for images that do not show it.
    """
    whole = images_with_pose(table)
    starts = _by_points(table, A, lens, usual.size, on_tip)
    if whole.sum() >= _ENOUGH:
        posed, at = table.select(whole), A[whole]
        if lens is None:
            lens = starts[0].lens if starts else _lens_by_arm(posed, at, usual, on_tip)
        try:
            starts.append(BodyStart(lens, _by_arm(find_mounting(at, body_poses(posed, lens), on_tip), A)))
        except ModcalError:
            if not starts:
                raise
    if not starts:
        said = f"few show four points that tell a pose, and no point is seen often enough among {table.views} images"
        raise NotEnoughData("images", said, "take 25 images or more of the same points, or such as show more points")
    return min(starts, key=lambda start: start.miss_px(table))


def require_order(table: CornerTable, lens: Lens, target: MarkerBundle) -> None:
    """Raises BadTable where the corners of markers are numbered in another order than the target's file says."""
    whole = images_with_pose(table)
    if not target.turning or whole.sum() < _ENOUGH:
        return
    rows = np.flatnonzero(whole)[: _LOOKED_AT // 2]
    some = table.select(np.isin(np.arange(table.views), rows))
    miss = {}
    for k in range(MARKER_CORNERS):
        for names in (np.roll(target.corners, k), np.roll(target.corners[::-1], k)):
            order = tuple(str(name) for name in names)
            own = replace(target, corners=order)
            there = replace(some, points=own.points[some.ids])
            miss[order] = float(np.median(body_poses(there, lens).rms))
    best = min(miss, key=lambda order: miss[order])
    if miss[best] * _CLEAR < miss[target.corners]:
        said = f"numbers the corners of markers as {', '.join(target.corners)}; the images show {', '.join(best)}"
        raise BadTable(target.label, said, f"state corner_order: [{', '.join(best)}]")


def _by_arm(mounting: Mounting, A: Array) -> Mounting:
    """The mounting with the poses that it puts the target at in all images, those without a pose among them."""
    T = mounting.T_frame_base @ A @ mounting.T_tip_tool
    return replace(mounting, T_camera_target=se3.inverse(T) if mounting.camera_on_tip else T)


def _lens_by_arm(table: CornerTable, A: Array, usual: Lens, on_tip: bool | None) -> Lens:
    """The lens without distortion whose poses of the body meet the flange's best."""
    rows = np.zeros(table.views, bool)
    rows[np.unique(np.linspace(0, table.views - 1, _LOOKED_AT).astype(int))] = True
    table, A, size, model = table.select(rows), A[rows], usual.size, usual.model

    def miss(focal: float) -> float:
        return mounting_misfit(A, body_poses(table, Lens.plain(focal, size, model)), on_tip)

    tried = 0.5 * max(size) / _HALF_ANGLES if model == FISHEYE else _FOCALS * max(size)
    best = min(tried.tolist(), key=miss)
    return Lens.plain(min((best * _FINER).tolist(), key=miss), size, model)


def _by_points(
    table: CornerTable, A: Array, lens: Lens | None, size: tuple[int, int], on_tip: bool | None
) -> list[BodyStart]:
    """The start from sightings of single points, nothing where they are too few or tell no mounting."""
    if table.views < MIN_VIEWS:
        return []
    ids, point = np.unique(table.ids, return_inverse=True)
    body = np.array([table.points[table.ids == i][0] for i in ids])
    middle = 0.5 * (np.array(size) - 1.0)
    rays = (table.pixels - middle) / max(size) if lens is None else lens.rays(table.pixels)
    found: dict[bool, Resection] = {}
    for carried in (True, False) if on_tip is None else (on_tip,):
        flange = se3.inverse(A) if carried else A
        one = resection(flange[table.view], point, rays, body, lens is not None)
        if one is not None:
            found[carried] = one
    if not found:
        return []
    carried = min(found, key=lambda c: found[c].miss)
    rival = found[not carried].miss / max(found[carried].miss, 1e-12) if len(found) == 2 else np.inf
    if rival < _CLEAR:
        return []
    best = found[carried]
    if lens is None:
        lens = Lens.plain(best.focal * max(size), size)
    base, tool = best.T_camera_base, best.T_tip_body
    if carried:  # it is the camera that is on the tip: T_camera_tip and T_base_body
        base, tool = se3.inverse(tool), se3.inverse(base)
    away = float(np.median(np.linalg.norm((best.T_camera_base @ (se3.inverse(A) if carried else A))[:, :3, 3], axis=1)))
    mounting = Mounting(carried, base, tool, A, best.miss * away, float(rival), relative_turns(A), np.empty(0))
    return [BodyStart(lens, _by_arm(mounting, A))]

"""Camera and body from points that are too few in each image for a pose, but are seen from many postures.

A point that stands at y on the tip is seen, up to a factor, at P A ỹ, with A the flange pose and P the camera's matrix
in the base. That is linear in the products of P's and y's elements, 39 of them, which the sightings of one point show
to a factor; their 9 × 4 part has rank one, which parts y from P. Then P by all points, and each point by P, in turn,
and the body is laid into its points (Kabsch). With the flange's inverse it is the same for a camera on the tip and a
body in the world.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import procrustes
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
    zero = np.zeros_like(phi)
    rows = np.concatenate([np.c_[phi, zero, -rays[:, :1] * phi], np.c_[zero, phi, -rays[:, 1:] * phi]])
    scale = 1.0 / np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    w = scale * np.linalg.svd(rows * scale, full_matrices=False)[2][-1]
    w = w.reshape(3, 13)
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
    zero = np.zeros_like(unit)
    rows = np.concatenate([np.c_[unit, zero, -rays[:, :1] * unit], np.c_[zero, unit, -rays[:, 1:] * unit]])
    return np.asarray(np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 4) @ to_unit)


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

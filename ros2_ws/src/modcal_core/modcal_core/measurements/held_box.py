"""Pose and size of a box from points on its faces, as calibrated range sensors on a gripper hit them.

A point p on the face at the end ``s = ±1`` of the box's axis k obeys ``s R_kᵀ (p − c) = h_k``, with R_k the axis, c the
centre and h_k half the size. For a given R this is linear in ``R_kᵀ c`` and h_k, axis by axis, so only the rotation is
searched for, from many starts (variable projection). Which of the rotations that make the same box it is follows from
the labels of the faces and from the sensors being outside. Where one end of an axis was hit alone, its size must be
known, or only the face is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from modcal_core.errors import BadTable, NotEnoughData
from modcal_core.geometry import Array, se3, so3

FACES = ("-x", "+x", "-y", "+y", "-z", "+z")
_STARTS = 300  # orientations, at random; neighbours are some 20° apart, and a box looks alike every 90°
_POLISHED = 6  # of the best, that are fitted
_OUTSIDE = 0.8  # share of the rays that must meet the outer side of their face; a few graze an edge
_NAMED = 0.3  # share of a direction (of unit length) above which a value is named as part of it
_GRAZING = 0.1  # cosine below which a ray says no more of a face
_WEAK = 1e-6  # of the largest singular value, in columns of unit length


@dataclass(frozen=True)
class Box:
    """T_frame_box: pose of the box's centre in the frame of the points, (4, 4). size: along its axes [m], (3,).
    covariance: of (shift of the centre along the box's axes [m], turn about them [rad], size [m]), (9, 9); zero for a
    size that was given. residual: distances of the points from their faces [m], (N,).
    """

    T_frame_box: Array
    size: Array
    covariance: Array
    residual: Array

    @property
    def std(self) -> Array:
        """Standard deviations, (9,)."""
        return np.sqrt(np.diag(self.covariance))


def hit_points(rays: ArrayLike, lengths: ArrayLike) -> Array:
    """Points (N, 3) that rays (N, 6), origin and direction of length one, meet at these lengths (N,) [m]."""
    rays, lengths = np.asarray(rays, dtype=float), np.asarray(lengths, dtype=float)
    return np.asarray(rays[:, :3] + lengths[:, None] * rays[:, 3:])


def measure_box(
    rays: ArrayLike, lengths: ArrayLike, faces: Sequence[str], sigma: ArrayLike, size: ArrayLike | None = None
) -> Box:
    """The box that these rays meet from outside.

    rays: (N, 6), origin and direction of length one, in one frame. lengths: what the sensors read [m], (N,). faces: the
    face that each ray meets, of FACES. sigma: standard deviation of the lengths [m], (N,) or one number. size: what is
    known of it (3,), NaN for what is not. Raises BadTable for input that cannot be, NotEnoughData where the points
    leave something open, saying what.
    """
    r, p, axis, end, s = _checked(rays, lengths, faces, sigma)
    known = np.full(3, np.nan) if size is None else np.asarray(size, dtype=float)
    _require_ends(axis, end, known)
    centre = p.mean(axis=0)

    def miss(w: Array, R: Array) -> Array:
        turned = R @ so3.exp(w)
        # a length errs along its ray, a point from its face by that times the cosine between them
        steep = np.maximum(np.abs(np.sum(turned.T[axis] * r[:, 3:], axis=1)), _GRAZING)
        return _solved(turned, p - centre, axis, end, s * steep, known)[2] / (s * steep)

    starts = Rotation.random(_STARTS, rng=np.random.default_rng(0)).as_matrix()
    cost = [float(np.sum(miss(np.zeros(3), R) ** 2)) if _outside(R, r, p, axis, end) else np.inf for R in starts]
    found = [(least_squares(miss, np.zeros(3), args=(starts[k],)), starts[k]) for k in np.argsort(cost)[:_POLISHED]]
    R = min(((x.cost, i, R @ so3.exp(x.x)) for i, (x, R) in enumerate(found)), key=lambda best: best[:2])[2]
    if not _outside(R, r, p, axis, end):
        raise NotEnoughData(
            f"{len(p)} rays on the box", "no box has these faces there", "check which ray meets which face"
        )
    steep = np.maximum(np.abs(np.sum(R.T[axis] * r[:, 3:], axis=1)), _GRAZING)
    along, half, residual = _solved(R, p - centre, axis, end, s * steep, known)
    T = se3.transform(R, centre + R @ along)
    return Box(T, 2.0 * half, _covariance(T, p, axis, end, s * steep, known), residual)


def _outside(R: Array, rays: Array, p: Array, axis: np.ndarray, end: Array) -> bool:
    """Whether most of the rays come from outside the faces that they meet."""
    return bool(np.mean(end * np.sum(R.T[axis] * (rays[:, :3] - p), axis=1) > 0.0) > _OUTSIDE)


def _checked(
    rays: ArrayLike, lengths: ArrayLike, faces: Sequence[str], sigma: ArrayLike
) -> tuple[Array, Array, np.ndarray, Array, Array]:
    r, lengths = np.asarray(rays, dtype=float), np.asarray(lengths, dtype=float)
    if r.ndim != 2 or r.shape != (len(faces), 6) or lengths.shape != (len(faces),):
        said = f"shapes {r.shape} and {lengths.shape} for {len(faces)} faces"
        raise BadTable("rays on the box", said, "give (N, 6) rays and (N,) lengths")
    if not (np.isfinite(r).all() and np.isfinite(lengths).all() and (lengths > 0.0).all()):
        raise BadTable("rays on the box", "a length is not positive or not finite", "leave out rays that meet nothing")
    if np.abs(np.linalg.norm(r[:, 3:], axis=1) - 1.0).max() > 1e-3:
        raise BadTable("rays on the box", "a direction does not have length one", "give unit vectors")
    wrong = sorted({f for f in faces if f not in FACES})
    if wrong:
        raise BadTable(f"face '{wrong[0]}'", "is not a face of a box", f"name {', '.join(FACES)}")
    s = np.broadcast_to(np.asarray(sigma, dtype=float), (len(r),))
    if not (np.isfinite(s).all() and (s > 0.0).all()):
        raise BadTable("sigma of the lengths", "is not positive", "give metres")
    number = np.array([FACES.index(f) for f in faces])
    return r, hit_points(r, lengths), number // 2, np.where(number % 2, 1.0, -1.0), s


def _require_ends(axis: np.ndarray, end: Array, known: Array) -> None:
    for k, name in enumerate("xyz"):
        ends = set(end[axis == k].tolist())
        if not ends:
            raise NotEnoughData(f"box, axis {name}", "neither of its faces was hit", f"hit the face +{name} or -{name}")
        if len(ends) == 1 and not np.isfinite(known[k]):
            raise NotEnoughData(
                f"box, size along {name}", "only one of its two faces was hit", "hit the other too, or state the size"
            )


def _solved(R: Array, p: Array, axis: np.ndarray, end: Array, s: Array, known: Array) -> tuple[Array, Array, Array]:
    """(centre along the box's axes (3,), half sizes (3,), residuals (N,)) for a rotation."""
    along, half, residual = np.zeros(3), 0.5 * known, np.zeros(len(p))
    for k in range(3):
        rows = axis == k
        y = end[rows] * (p[rows] @ R[:, k])
        design = end[rows, None]
        if np.isfinite(known[k]):
            y = y - half[k]
        else:
            design = np.c_[design, np.ones(len(y))]
        x = np.linalg.lstsq(design / s[rows, None], y / s[rows], rcond=None)[0]
        along[k] = x[0]
        half[k] = half[k] if np.isfinite(known[k]) else x[1]
        residual[rows] = y - design @ x
    return along, half, residual


def _covariance(T: Array, p: Array, axis: np.ndarray, end: Array, s: Array, known: Array) -> Array:
    """(9, 9); raises NotEnoughData where the points leave a motion of the box open."""
    inside = se3.apply(se3.inverse(T), p)
    J = np.zeros((len(p), 9))
    rows = np.arange(len(p))
    J[rows, axis] = -end
    # a turn of the box moves its face under the point by ω × p
    J[:, 3:6] = end[:, None] * np.cross(inside, np.eye(3)[axis])
    J[rows, 6 + axis] = -0.5
    free = np.r_[np.ones(6, bool), ~np.isfinite(known)]
    J = (J / s[:, None])[:, free]
    length = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    _, value, V = np.linalg.svd(J / length, full_matrices=True)
    value = np.r_[value, np.zeros(J.shape[1] - len(value))]
    if value[-1] < _WEAK * value[0]:
        names = [f"{what} {a}" for what in ("shift along", "turn about", "size") for a in "xyz"]
        weak = [n for n, share in zip(np.array(names)[free], np.abs(V[-1]), strict=True) if share > _NAMED]
        raise NotEnoughData(f"{len(p)} rays on the box leave open", " with ".join(weak), "hit faces in more places")
    out = np.zeros((9, 9))
    inner = V.T @ np.diag(value**-2.0) @ V
    out[np.ix_(free, free)] = inner / np.outer(length, length)
    return out

"""Pose and size of a box from points on its faces, as calibrated range sensors on a gripper hit them.

A point p on the face at the end ``s = ±1`` of the box's axis k obeys ``s R_kᵀ (p − c) = h_k``, with R_k the axis, c the
centre and h_k half the size. For a given R this is linear in ``R_kᵀ c`` and h_k, axis by axis, so only the rotation is
searched for, from many starts (variable projection). Which of the rotations that make the same box it is follows from
the labels of the faces and from the sensors being outside. Where one end of an axis was hit alone, its size must be
known, or only the face is.

Of a distance d from a face with covariance Σ the part Qᵀd, with Q across all that a box can do, must be noise: its
χ² judges the box. It falls by ``(uᵀS⁻¹y)² / uᵀS⁻¹u`` (u = Qᵀe_i, y = Qᵀd, S = QᵀΣQ) where ray i is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag, null_space
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from modcal_core.errors import BadTable, NotEnoughData
from modcal_core.geometry import Array, se3, so3

FACES = ("-x", "+x", "-y", "+y", "-z", "+z")
_STARTS = 300  # orientations, at random; neighbours are some 20° apart, and a box looks alike every 90°
_POLISHED = 6  # of the best, that are fitted
_OUTSIDE = 0.8  # share of the rays that must meet the outer side of their face; a few graze an edge
_NAMED = 0.3  # share of a direction (of unit length) above which a value is named as part of it
_GRAZING = 0.1  # cosine below which a ray says no more of a face
_WEAK = 1e-6  # of the largest singular value, in columns of unit length
_CHANCE = 1e-5  # of a sound scan whose residuals are taken for too large: a cell measures thousands of boxes a week
_LARGEST_TURN = 0.1  # rad, standard deviation, beyond which no covariance describes an orientation
_SURE = 3.0  # standard deviations beyond an edge, from which a ray has missed its face


@dataclass(frozen=True)
class Scan:
    """Rays that meet a box from outside. names: of the sensors, N. rays: (N, 6), origin and direction of length one, in
    one frame. lengths: what the sensors read [m], (N,). faces: that each meets, of FACES. sigma: standard deviation of
    the lengths [m], (N,) or one number. shared: covariance of the points that are hit [m²], (3 N, 3 N), from what is
    uncertain of the rays; None: nothing.
    """

    names: Sequence[str]
    rays: Array
    lengths: Array
    faces: Sequence[str]
    sigma: ArrayLike
    shared: Array | None = None


@dataclass(frozen=True)
class Box:
    """T_frame_box: pose of the box's centre in the frame of the rays, (4, 4). size: along its axes [m], (3,).
    covariance: of (shift of the centre along the box's axes [m], turn about them [rad], size [m]), (9, 9); zero for a
    size that was given. residual: distances of the points from their faces [m], (N,). spare: readings beyond what
    determines the box; with none, nothing checks it.
    """

    T_frame_box: Array
    size: Array
    covariance: Array
    residual: Array
    spare: int

    @property
    def std(self) -> Array:
        """Standard deviations, (9,)."""
        return np.sqrt(np.diag(self.covariance))


def hit_points(rays: ArrayLike, lengths: ArrayLike) -> Array:
    """Points (N, 3) that rays (N, 6), origin and direction of length one, meet at these lengths (N,) [m]."""
    rays, lengths = np.asarray(rays, dtype=float), np.asarray(lengths, dtype=float)
    return np.asarray(rays[:, :3] + lengths[:, None] * rays[:, 3:])


def measure_box(scan: Scan, size: ArrayLike | None = None) -> Box:
    """The box that these rays meet. size: what is known of it [m], (3,), NaN for what is not.

    Raises BadTable for input that cannot be, and NotEnoughData where the points leave something open, where a ray has
    missed its face, or where no box explains the lengths, naming what.
    """
    r, p, axis, end, points = _checked(scan)
    known = np.full(3, np.nan) if size is None else np.asarray(size, dtype=float)
    _require_ends(axis, end, known)
    centre = p.mean(axis=0)
    own = np.stack([points[k : k + 3, k : k + 3] for k in range(0, len(points), 3)])

    def sigma(R: Array) -> Array:
        """Standard deviations of the points' distances from their faces (N,); a grazing ray counts as a steeper one."""
        n = R.T[axis]
        return np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", n, own, n), (_GRAZING * _lengths_std(scan)) ** 2))

    def miss(w: Array, R: Array) -> Array:
        turned = R @ so3.exp(w)
        s = sigma(turned)
        return _solved(turned, p - centre, axis, end, s, known)[2] / s

    starts = Rotation.random(_STARTS, rng=np.random.default_rng(0)).as_matrix()
    cost = [float(np.sum(miss(np.zeros(3), R) ** 2)) if _outside(R, r, p, axis, end) else np.inf for R in starts]
    found = [(least_squares(miss, np.zeros(3), args=(starts[k],)), starts[k]) for k in np.argsort(cost)[:_POLISHED]]
    R = min(((x.cost, i, R @ so3.exp(x.x)) for i, (x, R) in enumerate(found)), key=lambda best: best[:2])[2]
    if not _outside(R, r, p, axis, end):
        raise NotEnoughData(f"{len(p)} rays on the box", "no box has these faces there", "check which face each meets")
    s = sigma(R)
    along, half, residual = _solved(R, p - centre, axis, end, s, known)
    T = se3.transform(R, centre + R @ along)
    normals = block_diag(*(end[:, None] * R.T[axis]))
    noise = normals @ points @ normals.T
    J, free = _derivatives(T, p, axis, end, s, known)
    _require_box(scan, J, residual, noise)
    _require_hits(scan, se3.apply(se3.inverse(T), p), axis, half, s)
    gain = np.linalg.pinv(J / s[:, None]) / s
    covariance = np.zeros((9, 9))
    covariance[np.ix_(free, free)] = gain @ noise @ gain.T
    box = Box(T, 2.0 * half, covariance, residual, len(p) - int(free.sum()))
    if (turn := float(box.std[3:6].max())) > _LARGEST_TURN:
        about = f"turn about {'xyz'[int(np.argmax(box.std[3:6]))]} to ± {np.degrees(turn):.0f}°"
        raise NotEnoughData(f"{len(p)} rays on the box leave open", about, "hit its faces farther apart")
    return box


def _outside(R: Array, rays: Array, p: Array, axis: np.ndarray, end: Array) -> bool:
    """Whether most of the rays come from outside the faces that they meet."""
    return bool(np.mean(end * np.sum(R.T[axis] * (rays[:, :3] - p), axis=1) > 0.0) > _OUTSIDE)


def _lengths_std(scan: Scan) -> Array:
    return np.broadcast_to(np.asarray(scan.sigma, dtype=float), (len(scan.faces),))


def _checked(scan: Scan) -> tuple[Array, Array, np.ndarray, Array, Array]:
    """(rays, points, axes and ends of their faces, covariance of the points (3 N, 3 N))."""
    r, lengths, faces = np.asarray(scan.rays, dtype=float), np.asarray(scan.lengths, dtype=float), scan.faces
    if r.ndim != 2 or r.shape != (len(faces), 6) or lengths.shape != (len(faces),):
        said = f"shapes {r.shape} and {lengths.shape} for {len(faces)} faces"
        raise BadTable("rays on the box", said, "give (N, 6) rays and (N,) lengths")
    if not (np.isfinite(r).all() and np.isfinite(lengths).all() and (lengths > 0.0).all()):
        raise BadTable("rays on the box", "a length is not positive or not finite", "leave out rays that meet nothing")
    if np.abs(np.linalg.norm(r[:, 3:], axis=1) - 1.0).max(initial=0.0) > 1e-3:
        raise BadTable("rays on the box", "a direction does not have length one", "give unit vectors")
    wrong = sorted({f for f in faces if f not in FACES})
    if wrong:
        raise BadTable(f"face '{wrong[0]}'", "is not a face of a box", f"name {', '.join(FACES)}")
    s = _lengths_std(scan)
    if not (np.isfinite(s).all() and (s > 0.0).all()):
        raise BadTable("sigma of the lengths", "is not positive", "give metres")
    number = np.array([FACES.index(f) for f in faces], dtype=int)
    points = block_diag(*(v**2 * np.outer(d, d) for v, d in zip(s, r[:, 3:], strict=True)))
    points = points if scan.shared is None else points + scan.shared
    return r, hit_points(r, lengths), number // 2, np.where(number % 2, 1.0, -1.0), points


def _require_ends(axis: np.ndarray, end: Array, known: Array) -> None:
    for k, name in enumerate("xyz"):
        ends = set(end[axis == k].tolist())
        if not ends:
            raise NotEnoughData(f"box, axis {name}", "neither of its faces was hit", f"hit the face +{name} or -{name}")
        if len(ends) == 1 and not np.isfinite(known[k]):
            raise NotEnoughData(
                f"box, size along {name}", "only one of its two faces was hit", "hit the other too, or state the size"
            )


def _require_box(scan: Scan, J: Array, residual: Array, noise: Array) -> None:
    """Raises NotEnoughData where the residuals (N,) are no noise, naming the rays without which they are."""
    across = null_space(J.T)
    if not across.shape[1]:
        return
    y, S = across.T @ residual, np.linalg.inv(across.T @ noise @ across)
    total = float(y @ S @ y)
    if total <= chdtri(len(y), _CHANCE):
        return
    less = (across @ S @ y) ** 2 / np.einsum("ni,ij,nj->n", across, S, across)
    alone = total - less <= chdtri(max(len(y) - 1, 1), _CHANCE) if len(y) > 1 else np.zeros(len(less), bool)
    names = [name for name, fits in zip(scan.names, alone, strict=True) if fits]
    said = f"the rest fits without {' or without '.join(names)}" if names else "no single ray explains it"
    ratio = np.sqrt(total / len(y))
    raise NotEnoughData(
        f"{len(residual)} rays on the box",
        f"cannot tell: they leave {1e3 * np.abs(residual).max():.2g} mm, {ratio:.1f} times what is expected; {said}",
        "check which face each ray meets, and that what is held is a box at rest",
    )


def _require_hits(scan: Scan, inside: Array, axis: np.ndarray, half: Array, s: Array) -> None:
    """Raises NotEnoughData where a point, in the box's frame, lies beyond the edge of its face."""
    beyond = np.abs(inside) - half
    beyond[np.arange(len(inside)), axis] = -np.inf
    worst = int(np.argmax(beyond.max(axis=1) - _SURE * s))
    if (most := float(beyond[worst].max())) > _SURE * s[worst]:
        along, face = "xyz"[int(np.argmax(beyond[worst]))], scan.faces[worst]
        raise NotEnoughData(
            f"{scan.names[worst]} on the box",
            f"meets the plane of face {face} {1e3 * most:.1f} mm beyond its edge along {along}: it missed the box",
            "leave it out, or name the face that it meets",
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


def _derivatives(T: Array, p: Array, axis: np.ndarray, end: Array, s: Array, known: Array) -> tuple[Array, np.ndarray]:
    """(change of the outward distances per free value (N, k), which of the nine are free). Raises NotEnoughData where
    the points leave a motion of the box open.
    """
    inside = se3.apply(se3.inverse(T), p)
    J = np.zeros((len(p), 9))
    rows = np.arange(len(p))
    J[rows, axis] = -end
    # a turn of the box moves its face under the point by ω × p
    J[:, 3:6] = end[:, None] * np.cross(inside, np.eye(3)[axis])
    J[rows, 6 + axis] = -0.5
    free = np.r_[np.ones(6, bool), ~np.isfinite(known)]
    J = J[:, free]
    scaled = J / s[:, None]
    _, value, V = np.linalg.svd(scaled / np.maximum(np.linalg.norm(scaled, axis=0), 1e-300), full_matrices=True)
    value = np.r_[value, np.zeros(J.shape[1] - len(value))]
    if value[-1] < _WEAK * value[0]:
        names = [f"{what} {a}" for what in ("shift along", "turn about", "size") for a in "xyz"]
        weak = [n for n, share in zip(np.array(names)[free], np.abs(V[-1]), strict=True) if share > _NAMED]
        raise NotEnoughData(f"{len(p)} rays on the box leave open", " with ".join(weak), "hit faces in more places")
    return J, free

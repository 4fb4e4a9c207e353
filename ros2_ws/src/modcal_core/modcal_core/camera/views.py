"""Postures at which a target is in view, and those at which images tell the most in millimetres.

A first calibration says well enough where camera and target are. Postures are drawn about those of its images; those
stay that show the whole target, its front, tilted and far away within bounds; of a body with markers those that see it
from about where it was seen before. One after the other is taken that makes the expected error at the tool smallest,
over postures in view (A-optimal, greedy; each image's own joints and shift counted).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.camera.bundle import BoardView, CalibrationTarget, MarkerBundle
from modcal_core.camera.claim import frame_basis
from modcal_core.camera.corners import CornerTable
from modcal_core.camera.fit import CameraFit
from modcal_core.camera.lens import Lens
from modcal_core.errors import NotEnoughData
from modcal_core.geometry import Array, se3

POSTURES = 150  # which give the RMS over a range of joints to a few per cent
_TRIES = 20  # postures drawn for each that shows the target
_MIN_SEEN = 20  # postures that show the target, below which those of the images are taken
# Of a body, between two lines of sight: markers are read up to some 60° off square, so turned by half of that most of
# those that one image shows are still read.
_SAME_SIDE = float(np.radians(30.0))
_INSIDE = 0.6  # of the corners, inside the image, count as a target that is in view
_GRID = 8  # cells a side of an image


def postures_in_view(fit: CameraFit, rng: np.random.Generator) -> Array:
    """Postures (M, n) within the images' joint ranges that show the target.

    Where too few do, those of the images themselves, and what lies between neighbours among them.
    """
    q = fit.poses.q
    tried = rng.uniform(q.min(axis=0), q.max(axis=0), (_TRIES * POSTURES, q.shape[1]))
    good = tried[in_view(fit, tried)][:POSTURES]
    if len(good) >= _MIN_SEEN:
        return good
    a, b = rng.integers(len(q), size=(2, POSTURES))
    mixed = q[a] + rng.uniform(0.0, 1.0, (POSTURES, 1)) * (q[b] - q[a])
    return np.concatenate([q, mixed[in_view(fit, mixed)]])[:POSTURES]


def in_view(fit: CameraFit, q: Array) -> np.ndarray:
    """Whether the camera sees that side of the target which images show at these postures (M, n), (M,) bool."""
    T = fit.seen_at(q)
    points = fit.table.points[np.unique(fit.table.ids, return_index=True)[1]]  # that any image shows
    inside = _inside_image(fit.state.lens, T, points)[1].mean(axis=1) >= _INSIDE
    return np.asarray(inside & _same_side(fit, T, points.mean(axis=0)))


def _inside_image(lens: Lens, T: Array, points: Array, edge_px: float = 0.0) -> tuple[Array, np.ndarray]:
    """(points (C, 3) of the target at T_camera_target (M, 4, 4) as the camera has them, (M, C, 3); whether they are so
    far from the image's edge inside it, (M, C)).
    """
    X = np.einsum("mij,cj->mci", T[:, :3, :3], points) + T[:, None, :3, 3]
    ahead = X[:, :, 2] > 1e-3
    pixels = lens.project(np.where(ahead[:, :, None], X, [0.0, 0.0, 1.0]))
    return X, ahead & ((pixels >= edge_px) & (pixels < np.array(lens.size) - edge_px)).all(axis=2)


def _same_side(fit: CameraFit, T: Array, middle: Array) -> np.ndarray:
    """Whether a target at T_camera_target (M, 4, 4) shows its front as in the images, or a body from about where the
    camera is in some of them, (M,) bool. middle: of the target, (3,).
    """
    seen = fit.seen_at(fit.poses.q)
    if fit.table.places:
        now, before = (se3.inverse(poses)[:, :3, 3] - middle for poses in (T, seen))
        now, before = (back / np.linalg.norm(back, axis=1, keepdims=True) for back in (now, before))
        return np.asarray((now @ before.T).max(axis=1) > np.cos(_SAME_SIDE))
    front = np.sign(np.median(np.einsum("mi,mi->m", seen[:, :3, 2], seen[:, :3, 3])))
    return np.asarray(np.einsum("mi,mi->m", T[:, :3, 2], se3.apply(T, middle)) * front > 0.0)


def tilt_and_distance(seen: Array, centre: Array) -> tuple[Array, Array]:
    """(tilt of the sheet against the line of sight [rad], its distance [m]) of T_camera_target (N, 4, 4), (N,) each."""
    at = se3.apply(seen, centre)
    away = np.linalg.norm(at, axis=1)
    cosine = np.abs(np.einsum("ni,ni->n", seen[:, :3, 2], at)) / np.maximum(away, 1e-9)
    return np.arccos(np.clip(cosine, 0.0, 1.0)), away


_TILT = float(np.radians(20.0))  # below, the focal length is told by perspective of second order only
_DISTANCES = 1.3  # farthest over nearest
_COVERED = 0.4  # of the image, in a grid of eight by eight


@dataclass(frozen=True)
class ViewSpread:
    """By how much images differ. covered: share of the image's cells, eight by eight, that hold a corner of some image.
    tilt: of the target against the line of sight [rad], distance: of it [m]; least and largest.
    """

    covered: float
    tilt: tuple[float, float]
    distance: tuple[float, float]

    @classmethod
    def of(cls, table: CornerTable, size: tuple[int, int], seen: Array, centre: Array) -> ViewSpread:
        """That of these corners in images of this size [px], the target at T_camera_target (N, 4, 4) in each."""
        cell = np.clip((table.pixels * _GRID / np.array(size)).astype(int), 0, _GRID - 1)
        share = len(np.unique(cell[:, 0] * _GRID + cell[:, 1])) / _GRID**2
        tilt, away = tilt_and_distance(seen, centre)
        return cls(share, (float(tilt.min()), float(tilt.max())), (float(away.min()), float(away.max())))

    def sentences(self, body: bool = False) -> list[str]:
        """What these images leave open of the lens, each with what to do. body: the target is none that tilts."""
        out = []
        (_, tilt), (near, far) = self.tilt, self.distance
        if tilt < _TILT and not body:
            out.append(
                f"The target was never tilted by more than {np.degrees(tilt):.0f}°: focal length and distance cannot "
                "be told apart. Take images with 20° to 45° of tilt."
            )
        if far < _DISTANCES * near:
            out.append(
                f"All images are from {near:.2f} to {far:.2f} m: the distance and the lens go together. "
                "Take some from half as far, or twice as far."
            )
        if self.covered < _COVERED:
            out.append(
                f"Corners cover {100.0 * self.covered:.0f} % of the image: the lens is not known at its edges. "
                "Bring the target into every corner of the image."
            )
        return out


_PLANNED = 4000  # postures drawn
_POOL = 200  # of those that show the target, for time
_JUDGED = 60  # postures over which the error is expected
_EDGE_PX = 10.0  # from the image's edge
STEEPEST = float(np.radians(50.0))  # of the target against the line of sight; beyond, corners are found badly
_NEAR, _FAR = 0.5, 2.0  # times the median distance of the images so far
_WIDER = 0.25  # of each joint's range so far, beyond it on either side
_LEAST = 0.15  # rad or m, beyond it at least
_NOISE_PX = 0.1  # of a corner of a sharp image
_FEWEST = 0.5  # of the points of a body that images show so far


@dataclass(frozen=True)
class ImagePlan:
    """q: postures (K, n). expected_m: RMS error at the tool that is expected before and after each of them, (K + 1,).
    tilt: of the target [rad], distance: of it [m], (K,).
    """

    q: Array
    expected_m: Array
    tilt: Array
    distance: Array


def plan_images(fit: CameraFit, target: CalibrationTarget, count: int, rng: np.random.Generator) -> ImagePlan:
    """The next images after those of a fit. Raises NotEnoughData where hardly any posture shows the target."""
    pool = _pool(fit, target, rng)
    if len(pool) < count:
        said = f"{len(pool)} of {_PLANNED} postures near those of the images show the target, {count} are asked for"
        raise NotEnoughData("the next images", said, "ask for fewer, or take images over a wider range first")
    judged = pool[rng.permutation(len(pool))[:_JUDGED]]
    J = fit.flange_motions(judged).reshape(3 * len(judged), -1)
    if isinstance(target, MarkerBundle):  # the arm by itself
        basis = frame_basis(se3.apply(fit.tool_at(judged), fit.flange))
        J = J - basis @ (basis.T @ J)
    solved = fit.equations.solve(fit.sizes)
    use, H, P = solved.use, solved.H, J.shape[1]
    square = np.zeros(fit.covariance.shape)  # mean square at the tool by all values
    square[:P, :P] = J.T @ J / len(judged)
    square, told = square[np.ix_(use, use)], _information(fit, target, pool)[:, use[:, None], use]
    expected, chosen = [float(np.trace(np.linalg.solve(H, square)))], list[int]()
    for _ in range(count):
        left = np.trace(np.linalg.solve(H + told, np.broadcast_to(square, told.shape)), axis1=1, axis2=2)
        left[chosen] = np.inf
        chosen.append(int(np.argmin(left)))
        H = H + told[chosen[-1]]
        expected.append(float(left[chosen[-1]]))
    tilt, away = tilt_and_distance(fit.seen_at(pool[chosen]), target.points.mean(axis=0))
    return ImagePlan(pool[chosen], np.sqrt(expected), tilt, away)


def _shown(fit: CameraFit, target: CalibrationTarget, seen: Array) -> np.ndarray:
    """Which of the target's points an image shows that has it at T_camera_target (M, 4, 4), (M, C) bool: of a body
    those of the kind that images have, on faces that look at the camera.
    """
    X, shown = _inside_image(fit.state.lens, seen, target.points, _EDGE_PX)
    if isinstance(target, MarkerBundle):
        shown &= np.isin(np.arange(len(target.points)), np.unique(fit.table.ids))
        out = np.einsum("mij,cj->mci", seen[:, :3, :3], target.normals)
        facing = -np.einsum("mci,mci->mc", out, X) / np.maximum(np.linalg.norm(X, axis=2), 1e-9)
        shown &= (facing > np.cos(STEEPEST)) | (target.normals == 0.0).all(axis=1)
    return np.asarray(shown)


def _pool(fit: CameraFit, target: CalibrationTarget, rng: np.random.Generator) -> Array:
    """Postures (m, n) that show the whole target as it is wanted."""
    chain, q = fit.poses.model.serial, fit.poses.q
    low, high = q.min(axis=0), q.max(axis=0)
    wider = np.maximum(_WIDER * (high - low), _LEAST)
    # about the images that there are, so that many show the target
    tried = q[rng.integers(len(q), size=_PLANNED)] + wider * rng.standard_normal((_PLANNED, q.shape[1]))
    tried = np.clip(tried, np.maximum(low - wider, chain.lower), np.minimum(high + wider, chain.upper))
    seen, centre = fit.seen_at(tried), target.points.mean(axis=0)
    shown, (tilt, away) = _shown(fit, target, seen), tilt_and_distance(seen, centre)
    usual = float(np.median(tilt_and_distance(fit.seen_at(q), centre)[1]))
    wanted = (away > _NEAR * usual) & (away < _FAR * usual)
    if isinstance(target, MarkerBundle):
        wanted &= shown.sum(axis=1) >= _FEWEST * float(np.median(np.bincount(fit.table.view)))
    else:
        wanted &= shown.all(axis=1) & (tilt <= STEEPEST)
    return np.asarray(tried[wanted][in_view(fit, tried[wanted])][:_POOL])


def _information(fit: CameraFit, target: CalibrationTarget, q: Array) -> Array:
    """What an image at each of these postures says of all values, (M, V, V)."""
    views = []
    for k, shown in enumerate(_shown(fit, target, fit.seen_at(q))):
        ids = np.flatnonzero(shown)
        cov = np.tile(_NOISE_PX**2 * np.eye(2), (len(ids), 1, 1))
        views.append(BoardView(f"{k}", ids, np.zeros((len(ids), 2)), cov))
    first = fit.cameras.first
    camera = replace(first, table=CornerTable.of(views, target), poses=first.poses.at_postures(q))
    rows = camera.rows(fit.state, fit.cameras.columns[0])
    each = np.broadcast_to(np.eye(rows.grams.shape[1]), rows.grams.shape)
    by = rows.by_all(each, len(fit.covariance))[:, :-1, :-1]
    return replace(fit.equations, cameras=(rows,)).by_change(replace(fit.sizes, noise=1.0), {0: by})[0]

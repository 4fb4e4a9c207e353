"""Which images to take next: postures that show the target as a person would want it, and tell the most in millimetres.

From a first calibration, of a handful of images or one that is not to be applied, it is known well enough where camera
and target are. Postures are drawn within the joint limits about those of its images; those stay that show the whole
target, its front, tilted and far away within bounds. Of these, one after the other is taken that makes the expected
error at the tool smallest, over postures in view (A-optimal, greedy; each image's own joints and shift counted).
Of a body with markers those postures stay at which the camera sees it from about where it has seen it before, with some
markers in view; only what those show counts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.camera.bundle import BoardView, CalibrationTarget, MarkerBundle
from modcal_core.camera.claim import frame_basis, mean_square
from modcal_core.camera.corners import POSE, CornerTable
from modcal_core.camera.fit import CameraFit, camera_rows
from modcal_core.camera.views import in_view, inside_image, tilt_and_distance
from modcal_core.errors import NotEnoughData
from modcal_core.geometry import Array, se3

_TRIED = 4000  # postures drawn
_POOL = 200  # of those that show the target, for time
_JUDGED = 60  # postures over which the error is expected
_EDGE_PX = 10.0  # from the image's edge
STEEPEST = float(np.radians(50.0))  # of the target against the line of sight; beyond, corners are found badly
_NEAR, _FAR = 0.5, 2.0  # times the median distance of the images so far
_WIDER = 0.25  # of each joint's range so far, beyond it on either side
_MIN = 0.15  # rad or m, beyond it at least
_NOISE_PX = 0.1  # of a corner of a sharp image
_MIN_MARKERS = 3  # of a body; fewer show little of its pose by themselves


@dataclass(frozen=True)
class ImagePlan:
    """q: postures (K, n). expected_m: RMS error at the tool that is expected before and after each of them, (K + 1,).
    tilt: of the target [rad], distance: of it [m], (K,). markers: of a body, in view, (K,), None of a sheet.
    """

    q: Array
    expected_m: Array
    tilt: Array
    distance: Array
    markers: np.ndarray | None = None


def plan_images(fit: CameraFit, target: CalibrationTarget, count: int, rng: np.random.Generator) -> ImagePlan:
    """The next images after those of a fit. Raises NotEnoughData where hardly any posture shows the target."""
    pool = _pool(fit, target, rng)
    if len(pool) < count:
        said = f"{len(pool)} of {_TRIED} postures near those of the images show the target, {count} are asked for"
        raise NotEnoughData("the next images", said, "ask for fewer, or take images over a wider range first")
    rows, T = _rows(fit, target, pool)
    J = _at_tool(fit, target, pool[rng.permutation(len(pool))[:_JUDGED]])
    C = fit.covariance
    expected, chosen = [_rms(J, C)], list[int]()
    for _ in range(count):
        falls = [-np.inf if k in chosen else _fall(C, rows[k], J) for k in range(len(pool))]
        chosen.append(int(np.argmax(falls)))
        new = rows[chosen[-1]]  # of unit variance
        K = C @ new.T
        C = C - K @ np.linalg.solve(new @ K + np.eye(len(new)), K.T)
        expected.append(_rms(J, C))
    tilt, away = tilt_and_distance(fit.poses.seen(T[chosen]), target.points.mean(axis=0))
    markers = None
    if isinstance(target, MarkerBundle):
        markers = _markers(target, _shown(fit, target, fit.poses.seen(T[chosen])))
    return ImagePlan(pool[chosen], np.array(expected), tilt, away, markers)


def _at_tool(fit: CameraFit, target: CalibrationTarget, q: Array) -> Array:
    """Motions of the flange at postures q (M, n) per parameter, (M, 3, P): of a body those of the arm by itself."""
    J = fit.flange_motions(q)
    if isinstance(target, MarkerBundle):
        T = fit.poses.at_postures(q).tool_at(fit.state.values)
        basis = frame_basis(se3.apply(T, fit.flange))
        rows = J.reshape(-1, J.shape[2])
        J = (rows - basis @ (basis.T @ rows)).reshape(J.shape)
    return J


def _shown(fit: CameraFit, target: CalibrationTarget, seen: Array) -> np.ndarray:
    """Which of the target's points an image shows that has it at T_camera_target (M, 4, 4), (M, C) bool: of a body
    those of the kind that images have, on faces that look at the camera.
    """
    X, shown = inside_image(fit.state.lens, seen, target.points, _EDGE_PX)
    if isinstance(target, MarkerBundle):
        shown &= np.isin(np.arange(len(target.points)), np.unique(fit.table.ids))
        out = np.einsum("mij,cj->mci", seen[:, :3, :3], target.normals)
        facing = -np.einsum("mci,mci->mc", out, X) / np.maximum(np.linalg.norm(X, axis=2), 1e-9)
        shown &= (facing > np.cos(STEEPEST)) | (target.normals == 0.0).all(axis=1)
    return np.asarray(shown)


def _markers(target: MarkerBundle, shown: np.ndarray) -> np.ndarray:
    """How many markers have points among those shown (M, C), (M,)."""
    own = target.on_markers()[0]
    return np.stack([shown[:, own == k].any(axis=1) for k in range(target.marker_count)]).sum(axis=0)


def _pool(fit: CameraFit, target: CalibrationTarget, rng: np.random.Generator) -> Array:
    """Postures (m, n) that show the whole target as it is wanted."""
    chain, q = fit.poses.model.serial, fit.poses.q
    low, high = q.min(axis=0), q.max(axis=0)
    wider = np.maximum(_WIDER * (high - low), _MIN)
    # about the images that there are, so that many show the target
    tried = q[rng.integers(len(q), size=_TRIED)] + wider * rng.standard_normal((_TRIED, q.shape[1]))
    tried = np.clip(tried, np.maximum(low - wider, chain.lower), np.minimum(high + wider, chain.upper))
    at = fit.poses.at_postures(tried)
    seen, before = at.seen(at.tool_at(fit.state.values)), fit.poses.seen(fit.poses.tool_at(fit.state.values))
    shown = _shown(fit, target, seen)
    centre = target.points.mean(axis=0)
    tilt, away = tilt_and_distance(seen, centre)
    usual = float(np.median(tilt_and_distance(before, centre)[1]))
    wanted = (away > _NEAR * usual) & (away < _FAR * usual)
    if isinstance(target, MarkerBundle):
        wanted &= _markers(target, shown) >= min(_MIN_MARKERS, target.marker_count)
        return np.asarray(tried[wanted][in_view(fit, tried[wanted])][:_POOL])
    front = np.sign(np.median(np.einsum("ni,ni->n", before[:, :3, 2], before[:, :3, 3])))
    middle = np.einsum("mij,j->mi", seen[:, :3, :3], centre) + seen[:, :3, 3]
    side = np.einsum("mi,mi->m", seen[:, :3, 2], middle) * front > 0.0
    return np.asarray(tried[shown.all(axis=1) & side & wanted & (tilt <= STEEPEST)][:_POOL])


def _rows(fit: CameraFit, target: CalibrationTarget, q: Array) -> tuple[list[Array], Array]:
    """(for each image at these postures whitened rows (r, P) of what it says of all parameters, T_frame_tool)."""
    at = fit.poses.at_postures(q)
    T = at.tool_at(fit.state.values)
    views = []
    for k, shown in enumerate(_shown(fit, target, at.seen(T))):
        ids = np.flatnonzero(shown)
        cov = np.tile(_NOISE_PX**2 * np.eye(2), (len(ids), 1, 1))
        views.append(BoardView(f"{k}", ids, np.zeros((len(ids), 2)), cov))
    table = CornerTable.of(views, target)
    rows = camera_rows(table, at, fit.state, np.arange(len(fit.covariance)))
    G = rows.grams[:, :-1, :-1]
    E = G - G[:, :, :POSE] @ rows.own_twists(replace(fit.sizes, noise=1.0)) @ G[:, :POSE]
    P = fit.poses.count
    out = []
    for one, moved in zip(E, rows.moved, strict=True):
        A = np.zeros((len(one), len(fit.covariance)))
        A[:POSE, :P] = moved[:, :P]
        A[POSE:, P + 1 :] = np.eye(len(one) - POSE)
        scale = np.sqrt(np.maximum(np.diag(one), 1e-300))
        values, vectors = np.linalg.eigh(one / np.outer(scale, scale))
        keep = values > 1e-9 * values[-1]
        out.append((np.sqrt(values[keep])[:, None] * vectors[:, keep].T * scale) @ A)
    return out, T


def _rms(J: Array, C: Array) -> float:
    P = J.shape[2]
    return float(np.sqrt(mean_square(J, C[:P, :P])))


def _fall(C: Array, rows: Array, J: Array) -> float:
    """By how much the mean square at the tool falls, up to a factor."""
    K = C @ rows.T
    root = np.linalg.cholesky(rows @ K + np.eye(len(rows)))
    seen = np.linalg.solve(root, K.T[:, : J.shape[2]]) @ J.reshape(-1, J.shape[2]).T
    return float((seen**2).sum())

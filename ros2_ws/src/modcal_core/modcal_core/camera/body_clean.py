"""What is left out of the images of a body: points that are misread, and images taken elsewhere than the joints say.

An image of a body may show three points, which fit any pose, so it is the arm that points are held against: those that
are off by far more than the others, each image's own error counted, are out, and where most of an image is, the image.
"""

from __future__ import annotations

import numpy as np

from modcal_core.calibration.distributions import exceeded_chi2, median_chi2
from modcal_core.camera.corners import POSE, SHAPE, CornerTable, corner_rows
from modcal_core.camera.fit import CameraFit
from modcal_core.geometry import so3
from modcal_core.geometry.so3 import Array

_TO_SIGMA = 1.4826  # of a median absolute deviation, for normal errors
_POINT = 6.0  # robust standard deviations, as of corners of a sheet: one good point in a billion
_MOSTLY = 0.5  # of the points of an image, beyond which it is the image that is elsewhere
_VIEW_CHANCE = 1e-7  # of an image as far off as this, were it like the others
# Tolerances, and times the median marker, that a marker's place may differ from where the others have it: farther is
# another marker's sighting under its number, or a slip of the pen, which would make all places look as open as its own.
_FAR = 6.0
_MIN_MARKERS = 6  # of a body, for their median to be that of markers that are where they should be
_SEEN = 1e-9  # of an image's information; directions below it are none that it shows


def point_weights(fit: CameraFit) -> Array:
    """1 for points where the fit has them, each image's own error taken out, else 0, (M,)."""
    table = fit.table
    off = _own_taken_out(fit)
    size = np.abs(off)
    sigma = _TO_SIGMA * np.median(size[table.weight > 0.0])
    return np.asarray((size <= _POINT * max(float(sigma), 1e-9)).all(axis=1), dtype=float)


def far_markers(fit: CameraFit) -> np.ndarray:
    """Markers (K,) whose place is not where any hand would have glued them, in which points in use have a part.

    The body's frame is that of all its markers together, so each is held against the motion that the others show.
    """
    table, prior = fit.table, fit.prior.places
    assert prior is not None
    K, values = table.markers, table.places
    used = np.flatnonzero(np.bincount(table.marker, table.weight, K) > 0.0)
    out = np.zeros(K, bool)
    if len(used) < _MIN_MARKERS:
        return out
    middles = np.zeros((K, 3))
    middles[table.marker] = table.points - table.lever
    motion = np.zeros((K, values, 6))
    motion[:, :3, :3] = np.eye(3)
    motion[:, :3, 3:] = -so3.hat(middles)
    motion[:, 3:, 3:] = np.eye(3)[: values - 3]
    apart = prior.apart.reshape(K, values, K, values)[np.arange(K), :, np.arange(K)]
    white = np.swapaxes(np.linalg.cholesky(apart), 1, 2)
    off = (white @ fit.state.shape[SHAPE:].reshape(K, values, 1))[:, :, 0]
    moved = white @ motion
    for k in used:
        others = used[used != k]
        by = np.linalg.lstsq(moved[others].reshape(-1, 6), off[others].reshape(-1), rcond=None)[0]
        size = np.sqrt(((off - moved @ by) ** 2).mean(axis=1))
        out[k] = size[k] > _FAR * max(1.0, float(np.median(size[others])))
    return out


def mostly_out(table: CornerTable, out: np.ndarray) -> np.ndarray:
    """Images (N,) most of whose points (mask (M,)) are out."""
    count = np.bincount(table.view, minlength=table.views)
    return np.asarray(np.bincount(table.view, out.astype(float), table.views) > _MOSTLY * count)


def elsewhere(fit: CameraFit) -> np.ndarray:
    """Images (N,) that are nowhere near where the arm has them, the others' scatter being the scale.

    Of an image with few points it is those directions that it shows which count.
    """
    G = fit.equations.grams / fit.sizes.noise**2
    Q = fit.equations.covariance_of_views(fit.sizes)
    square, rank = np.zeros(len(G)), np.zeros(len(G), int)
    for i, (one, own) in enumerate(zip(G, Q, strict=True)):
        inner, score = one[:POSE, :POSE], one[:POSE, -1]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(inner), 1e-300))
        values, vectors = np.linalg.eigh(inner * np.outer(scale, scale))
        keep = values > _SEEN * max(values[-1], 1e-300)
        if not inner.any() or not keep.any():
            continue
        basis = (scale[:, None] * vectors[:, keep]) / np.sqrt(values[keep])
        # the score in directions of unit information: its covariance is 1 + that of the image's own twist
        z = basis.T @ score
        along = basis.T @ inner
        square[i] = z @ np.linalg.solve(np.eye(len(z)) + along @ own @ along.T, z)
        rank[i] = len(z)
    seen = rank > 0
    if not seen.any():
        return np.zeros(len(G), bool)
    usual = np.array([median_chi2(int(r)) if r else 1.0 for r in rank])
    most = np.array([exceeded_chi2(_VIEW_CHANCE, int(r)) if r else np.inf for r in rank])
    scale_of_all = max(float(np.median((square / usual)[seen])), 0.1)
    return np.asarray(seen & (square > scale_of_all * most))


def _own_taken_out(fit: CameraFit) -> Array:
    """Whitened residuals (M, 2) less what each image's own twist, as likely as it is, makes of them."""
    T, _ = fit.poses.tool_motions(fit.state.values, fit.state.offset_s)
    rows = corner_rows(fit.table, fit.state.lens, fit.state.shape, fit.poses.seen(T), fit.state.readout_s)
    G = fit.equations.grams / fit.sizes.noise**2
    S = fit.equations.solve(fit.sizes).S
    own = (S @ G[:, :POSE, -1:])[:, :, 0]
    return np.asarray(rows.residual - (rows.by_pose @ own[fit.table.view][:, :, None])[:, :, 0])

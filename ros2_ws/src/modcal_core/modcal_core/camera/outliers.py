"""Corners, markers and images that are not where the others have them, and the first fit, without these.

An image of a body may show three points, which fit any pose, so it is the arm that points are held against: those that
are off by far more than the others, each image's own error counted, are out, and where most of an image is, the image.

Misreadings of a body are spread over markers and images, and what is left of its points says as much as if they had not
been read. A marker most of whose points are out has another number, or another place, than the target's file states, or
came loose. Either is said; it speaks against the fit only where it is more than the others outvote.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import exceeded_chi2, median_chi2
from modcal_core.camera.bundle import MarkerBundle
from modcal_core.camera.corners import POSE, SHAPE, CornerTable, corner_rows
from modcal_core.camera.fit import START, CameraFit
from modcal_core.camera.images import PreparedImages
from modcal_core.camera.lens import Lens
from modcal_core.camera.mounting import MIN_VIEWS
from modcal_core.geometry import Array, so3

_TO_SIGMA = 1.4826  # of a median absolute deviation, for normal errors
_CORNER = 6.0  # robust standard deviations: one good corner in a billion
_CORNER_PX = 0.1  # where printers put a square's corner: 0.03 mm, in an image of a third of a millimetre a pixel
_IMAGE_PX, _IMAGE_TIMES = 1.0, 5.0  # RMS of an image that is blurred or misread: more than a pixel, and than the others
_ONE_LINE = 0.1  # of its length, how wide a group of corners is that is none
_ALL_BUT_ONE = 0.03  # the same once any one of them is left out; of a board's corners on a line nothing, of others 0.05
MIN_CORNERS = 4  # of an image, not on one line: the fewest that a homography is taken from
_MOSTLY = 0.5  # of the points of an image, or of a marker, beyond which it is not where it should be
_VIEW_CHANCE = 1e-7  # of an image as far off as this, were it like the others
# Tolerances, and times the median marker, that a marker's place may differ from where the others have it: farther is
# another marker's sighting under its number, or a slip of the pen, which would make all places look as open as its own.
_FAR = 6.0
_MIN_MARKERS = 6  # of a body, for their median to be that of markers that are where they should be
_SEEN = 1e-9  # of an image's information; directions below it are none that it shows
_GROSS = 10.0  # times the median distance from where corners should be: errors that are no one's share never reach it
_CLEANED = 5  # times that points and images are looked through
ELSEWHERE = "far from where the arm has it"


def corner_weights(table: CornerTable, lens: Lens, shape: Array, T_camera_target: Array) -> Array:
    """1 for corners that agree with the pose of the target in their own image, or nearly, else 0, (M,)."""
    rows = corner_rows(table, lens, shape, T_camera_target)
    agrees = _agreeing(table, rows.residual) | (np.abs(rows.pixels) <= _CORNER_PX)
    return np.where(agrees.all(axis=1), table.weight, 0.0)


def _agreeing(table: CornerTable, residual: Array) -> np.ndarray:
    """Which whitened residuals (M, 2) are no larger than those of the corners in use."""
    size = np.abs(residual)
    sigma = _TO_SIGMA * np.median(size[table.weight > 0.0])
    return np.asarray(size <= _CORNER * max(float(sigma), 1e-9))


def enough_corners(points: Array) -> bool:
    """Whether corners at these places on the sheet (m, 3) fix its pose: four of them, of which no three are on a line.

    That is so where they are not on one line, and are not once any one of them is left out.
    """
    m = len(points)
    if m < MIN_CORNERS:
        return False
    off = points[:, :2] - points[:, :2].mean(axis=0)
    scatter = off.T @ off
    without = scatter - m / (m - 1.0) * off[:, :, None] * off[:, None]
    spread = np.linalg.eigvalsh(np.concatenate([scatter[None], without]))
    width = np.sqrt(np.maximum(spread[:, 0], 0.0) / spread[:, 1])
    return bool(width[0] > _ONE_LINE and width[1:].min() > _ALL_BUT_ONE)


def bad_images(table: CornerTable, rms_px: Array) -> np.ndarray:
    """Images (N,) in which the target has too few corners left, or fits far worse than in the others."""
    worst = max(_IMAGE_PX, _IMAGE_TIMES * float(np.median(rms_px)))
    kept = [table.points[(table.view == i) & (table.weight > 0.0)] for i in range(table.views)]
    return np.array([not enough_corners(points) for points in kept]) | (rms_px > worst)


def gross(off: Array) -> np.ndarray:
    """Which corners (M,) have residuals (M, 2) above a multiple of the median."""
    size = np.linalg.norm(off, axis=1)
    return np.asarray(size > _GROSS * float(np.median(size)))


def mostly_out(table: CornerTable, out: np.ndarray) -> np.ndarray:
    """Images (N,) most of whose points (mask (M,)) are out."""
    count = np.bincount(table.view, minlength=table.views)
    return np.asarray(np.bincount(table.view, out.astype(float), table.views) > _MOSTLY * count)


def view_distances(fit: CameraFit) -> tuple[Array, np.ndarray]:
    """(squared distance of each image's pose from the arm's, in its own standard deviations, (N,); along how many
    directions it shows it, (N,), which is what it is on average).
    """
    rows = fit.equations.cameras[0]
    G, Q = rows.grams[:, :POSE] / fit.sizes.noise**2, rows.covariance_of_views(fit.sizes)
    inner = G[:, :, :POSE]
    scale = 1.0 / np.sqrt(np.maximum(np.einsum("nii->ni", inner), 1e-300))
    values, vectors = np.linalg.eigh(inner * scale[:, :, None] * scale[:, None])
    shown = values > _SEEN * np.maximum(values[:, -1:], 1e-300)
    basis = scale[:, :, None] * vectors * (shown / np.sqrt(np.where(shown, values, 1.0)))[:, None]
    # the score in directions of unit information: its covariance is 1 + that of the image's own twist
    back = np.swapaxes(basis, 1, 2)
    z, along = back @ G[:, :, -1:], back @ inner
    square = np.swapaxes(z, 1, 2) @ np.linalg.solve(np.eye(POSE) + along @ Q @ np.swapaxes(along, 1, 2), z)
    return square[:, 0, 0], shown.sum(axis=1)


def distances_of_views(fit: CameraFit) -> Array:
    """Squared distance of each image's pose from the arm's, in its own standard deviations, (N,): six on average."""
    return view_distances(fit)[0]


def elsewhere(fit: CameraFit) -> np.ndarray:
    """Images (N,) that are nowhere near where the arm has them, the others' scatter being the scale."""
    square, rank = view_distances(fit)
    usual = np.array([1.0, *(median_chi2(r) for r in range(1, POSE + 1))])[rank]
    most = np.array([np.inf, *(exceeded_chi2(_VIEW_CHANCE, r) for r in range(1, POSE + 1))])[rank]
    scale = max(float(np.median((square / usual)[rank > 0])), 0.1) if rank.any() else np.inf
    return np.asarray(square > scale * most)


def point_weights(fit: CameraFit) -> Array:
    """1 for points where the fit has them, each image's own error taken out, else 0, (M,)."""
    table = fit.table
    rows = corner_rows(table, fit.state.lens, fit.state.shape, fit.poses.seen(fit.tool), fit.state.readout_s)
    G = fit.equations.cameras[0].grams / fit.sizes.noise**2
    own = (fit.equations.solve(fit.sizes).S @ G[:, :POSE, -1:])[:, :, 0]  # its twist, as likely as it is
    residual = rows.residual - (rows.by_pose @ own[table.view][:, :, None])[:, :, 0]
    return np.asarray(_agreeing(table, residual).all(axis=1), dtype=float)


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


def first_fit(ready: PreparedImages) -> tuple[CameraFit, PreparedImages]:
    """(a fit, what it was made from): misread points of a body, and images nowhere near the arm, are left out.

    The sizes of errors stay usual until what is grossly elsewhere is out, for one such image or
    marker would make all errors look as large as its own; then they hardly change but for a marker that was far off.
    """
    if not ready.table.places:
        fit = ready.fitted()
        again = _without(ready, ready.table.weight == 0.0, fit)
        return (fit, ready) if again is None else (again.fitted(fit), again)
    far = np.zeros(ready.table.markers, bool)
    last: CameraFit | None = None
    for _ in range(_CLEANED):
        last = replace(ready.fitted(last, fixed_sizes=True), sizes=START)
        far |= far_markers(last)
        again = _without(ready, gross(last.pixels) | far[ready.table.marker])
        if again is None:
            break
        ready = again
    fit = ready.fitted(last)
    cleaned = False
    for _ in range(_CLEANED):
        more = far_markers(fit) & ~far
        far |= more
        again = _without(ready, (point_weights(fit) == 0.0) | far[ready.table.marker], fit)
        if again is None:
            break
        ready, cleaned = again, True
        fit = ready.fitted(fit, fixed_sizes=not more.any())
    return (ready.fitted(fit) if cleaned else fit), ready


def _without(ready: PreparedImages, out: np.ndarray, fit: CameraFit | None = None) -> PreparedImages | None:
    """The images without these points (M,) and without those most of whose points they are; None if nothing changes,
    or too little is left. fit: where points are as they were, without images that are elsewhere by it.
    """
    weight = np.where(out, 0.0, 1.0)
    strange = mostly_out(ready.table, out) if ready.table.places else np.zeros(ready.table.views, bool)
    if (weight == ready.table.weight).all() and not strange.any():
        # not before misread points are out, which draw their image away
        strange = strange if fit is None else elsewhere(fit)
        if not strange.any():
            return None
    if (~strange).sum() < MIN_VIEWS:
        return None
    ready = replace(ready, table=ready.table.with_weight(weight))
    return ready.select(~strange, ELSEWHERE) if strange.any() else ready


_SIGHTINGS = 8  # images of a marker, for most of them to say something of the marker
_PASSED = 0.05  # share of points left out that a verdict passes over (verdict.md)
# Share beyond which what is left is no majority to rely on: where a fifth of markers is misread, every second image
# that shows three has a misread one among them.
_TOO_MANY = 0.2
_NAMED = 3  # markers in a sentence


@dataclass(frozen=True)
class LeftOutPoints:
    """problems: what speaks against the fit. open: what a verdict may not pass over, though the fit stands."""

    problems: tuple[str, ...] = ()
    open: tuple[str, ...] = ()


def left_out_points(cameras: Sequence[tuple[str, CornerTable]], target: MarkerBundle) -> LeftOutPoints:
    """What is to be said of the points that were left out of the images of a body.

    cameras: (what a sentence calls it, corners, weight 0 where they are left out), of each that sees this body.
    """
    problems, open_ = [], []
    for name, table in cameras:
        out = table.weight == 0.0
        strange = []  # markers most of whose points are out, in images enough to say so
        for k in range(table.markers):
            own = table.marker == k
            if len(np.unique(table.view[own])) >= _SIGHTINGS and float(out[own].mean()) > _MOSTLY:
                strange.append(k)
        if strange:
            named = ", ".join(target.markers[k].label for k in strange[:_NAMED])
            more = f" and {len(strange) - _NAMED} more" if len(strange) > _NAMED else ""
            open_.append(
                f"Most points of {named}{more}{name} are nowhere near their place, and are left out: check number, "
                "place and corner_order in the target file, and whether it came loose."
            )
        rest = ~np.isin(table.marker, strange)
        share = float(out[rest].mean()) if rest.any() else 0.0
        if max(share, len(strange) / max(table.markers, 1)) > _TOO_MANY:
            problems.append(f"{100.0 * float(out.mean()):.0f} % of all points{name} fit no body of the stated form.")
        elif share > _PASSED:
            open_.append(
                f"{100.0 * share:.0f} % of the points{name} are misread, spread over markers and images, and left out."
            )
    return LeftOutPoints(tuple(problems), tuple(open_))

"""The images of one camera, made ready for a fit: its lens, the target's pose in each image, mounting, the start."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from modcal_core.calibration import ModelParameter, exceeded_chi2, median_chi2
from modcal_core.camera.arm_poses import NOTHING_KNOWN, ArmPoses, ImageMoments, arm_poses
from modcal_core.camera.body_start import (
    TO_SIGMA,
    VIEW_CHANCE,
    body_poses,
    elsewhere,
    far_markers,
    images_with_pose,
    mostly_out,
    point_weights,
    require_order,
    start_of_body,
)
from modcal_core.camera.bundle import BoardView, CalibrationTarget, MarkerBundle
from modcal_core.camera.corners import FREE, POSE, SHAPE, CommonPrior, CornerTable, common_prior, corner_rows, residuals
from modcal_core.camera.fit import CameraFit, fit_camera
from modcal_core.camera.intrinsics import LensFit, board_poses, first_lens, fit_lens
from modcal_core.camera.lens import COUNT as LENS
from modcal_core.camera.lens import FISHEYE, PINHOLE, Lens
from modcal_core.camera.mounting import MIN_VIEWS, Mounting, explained, find_mounting
from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.geometry import Array
from modcal_core.robots import Chain, Inertias, chain_forward

_CORNER = 6.0  # robust standard deviations: one good corner in a billion
_CORNER_PX = 0.1  # where printers put a square's corner: 0.03 mm, in an image of a third of a millimetre a pixel
_IMAGE_PX, _IMAGE_TIMES = 1.0, 5.0  # RMS of an image that is blurred or misread: more than a pixel, and than the others
_ONE_LINE = 0.1  # of its length, how wide a group of corners is that is none
_ALL_BUT_ONE = 0.03  # the same once any one of them is left out; of a board's corners on a line nothing, of others 0.05
MIN_CORNERS = 4  # of an image, not on one line: the fewest that a homography is taken from


def corner_weights(table: CornerTable, lens: Lens, shape: Array, T_camera_target: Array) -> Array:
    """1 for corners that agree with the pose of the target in their own image, or nearly, else 0, (M,)."""
    rows = corner_rows(table, lens, shape, T_camera_target)
    size = np.abs(rows.residual)
    sigma = TO_SIGMA * np.median(size[table.weight > 0.0])
    agrees = (size <= _CORNER * max(float(sigma), 1e-9)) | (np.abs(rows.pixels) <= _CORNER_PX)
    return np.where(agrees.all(axis=1), table.weight, 0.0)


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
    kept = np.bincount(table.view, table.weight, table.views)
    worst = max(_IMAGE_PX, _IMAGE_TIMES * float(np.median(rms_px)))
    few = [not enough_corners(table.points[table.of_view(i)][_kept(table, i)]) for i in range(table.views)]
    return np.asarray(few) | (kept < MIN_CORNERS) | (rms_px > worst)


def _kept(table: CornerTable, view: int) -> np.ndarray:
    return np.asarray(table.weight[table.of_view(view)] > 0.0)


def distances_of_views(fit: CameraFit) -> Array:
    """Squared distance of each image's pose from the arm's, in its own standard deviations, (N,): six on average."""
    G = fit.equations.cameras[0].grams / fit.sizes.noise**2
    Gpp, g = G[:, :POSE, :POSE], G[:, :POSE, -1:]
    Q = fit.equations.cameras[0].covariance_of_views(fit.sizes)
    inverse = np.linalg.pinv(Gpp, hermitian=True)
    off = inverse @ g
    return np.asarray((np.swapaxes(off, 1, 2) @ np.linalg.solve(inverse + Q, off))[:, 0, 0])


def strangers(fit: CameraFit) -> np.ndarray:
    """Images (N,) whose pose of the target is nowhere near the arm's, the others' scatter being the scale."""
    square = distances_of_views(fit)
    scale = max(float(np.median(square)) / median_chi2(POSE), 0.1)
    return np.asarray(square > scale * exceeded_chi2(VIEW_CHANCE, POSE))


_NOWHERE, _NOWHERE_TIMES = 0.1, 10.0  # of the reach, and of the others' misfit: an image of elsewhere, or turned round
_ELSEWHERE = "far from where the arm has it"
_APART_OF_REACH = 0.03  # misfit of images and arm, as a share of the reach: no arm is built that badly


@dataclass(frozen=True)
class CameraImages:
    """What one camera saw. name: of its topic, for messages. q, velocity: of the joints at each view, (N, n); None:
    they stood. size: of the images [px]. lens: as stated, with what becomes of it: free (a start), tolerance, fixed;
    None: found from the images. camera_on_tip: the mounting where it is stated. flat: the sheet is known to be flat.
    moments: for effects. fisheye: whether the lens is one, where nothing is stated of it.
    """

    q: Array
    views: Sequence[BoardView]
    target: CalibrationTarget
    size: tuple[int, int]
    velocity: Array | None = None
    lens: Lens | None = None
    stated: str = FREE
    camera_on_tip: bool | None = None
    flat: bool = False
    moments: ImageMoments = NOTHING_KNOWN
    fisheye: bool = False
    name: str = "images"

    def select(self, rows: np.ndarray) -> CameraImages:
        """With these images only (mask (N,))."""
        return replace(
            self,
            q=self.q[rows],
            views=[view for view, keep in zip(self.views, rows, strict=True) if keep],
            velocity=None if self.velocity is None else self.velocity[rows],
            moments=self.moments.select(rows),
        )


# what is looked at, its corners, the lens, expectations, the mounting, and images that are left out, by reason
_Seen = tuple[CameraImages, CornerTable, LensFit, CommonPrior, Mounting, dict[str, str]]


@dataclass(frozen=True)
class PreparedImages:
    """target: that was seen. table: its corners. poses: the nominal arm at the images, base and tool as found. placed:
    parameters of these alone. lens_fit: from the images alone. prior: of lens and sheet. mounting: as found. left_out:
    images by reason.
    """

    target: CalibrationTarget
    table: CornerTable
    poses: ArmPoses
    placed: tuple[ModelParameter, ...]
    lens_fit: LensFit
    prior: CommonPrior
    mounting: Mounting
    left_out: dict[str, str]

    def select(self, rows: np.ndarray, why: str) -> PreparedImages:
        """With these images only. why: the others are left out."""
        out = {n: why for n, keep in zip(self.table.names, rows, strict=True) if not keep}
        return replace(self, table=self.table.select(rows), poses=self.poses.select(rows), left_out=self.left_out | out)


def prepare_images(
    chain: Chain,
    images: CameraImages,
    fixed: Sequence[str] = (),
    inertias: Inertias | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> PreparedImages:
    """The images of one camera, ready for a fit.

    fixed: parameters that stay as they are. Raises ModcalError for images that cannot carry a fit.
    """
    look = _of_body if isinstance(images.target, MarkerBundle) else _of_sheet
    images, table, lens_fit, prior, mounting, left_out = look(chain, images, progress)
    velocity = np.zeros_like(images.q) if images.velocity is None else images.velocity
    at = (chain, images.q, velocity, mounting.T_frame_base, mounting.T_tip_tool, mounting.camera_on_tip, fixed)
    poses = arm_poses(*at, moments=images.moments, inertias=inertias)
    placed = arm_poses(*at, hand_eye_only=True).parameters
    return PreparedImages(images.target, table, poses, placed, lens_fit, prior, mounting, left_out)


def _of_sheet(chain: Chain, images: CameraImages, progress: Callable[[str], None]) -> _Seen:
    target, lens = images.target, images.lens
    keep = np.array([enough_corners(target.points[v.ids]) for v in images.views], dtype=bool)
    left_out = {v.name: "too few corners of the target" for v, k in zip(images.views, keep, strict=True) if not k}
    for i, name in repeated(images.views).items():
        keep[i] = False
        left_out[images.views[i].name] = f"the same picture as {name}: the camera hung, or it was copied"
    images = images.select(keep)
    require_views(len(images.views), images.name)
    table = CornerTable.of(images.views, target)

    progress("lens")
    model = FISHEYE if images.fisheye else PINHOLE
    start = lens or first_lens(table, images.size, model)
    prior = common_prior(start, target.scale, images.stated if lens is not None else None, images.flat)
    lens_fit, table = _lens(table, lens, prior, images.size, model)
    poses = board_poses(table, lens_fit.lens, prior.shape)
    if (bad := bad_images(table, poses.rms)).any():
        left_out |= {n: "the target fits this image badly" for n, b in zip(table.names, bad, strict=True) if b}
        table, images = table.select(~bad), images.select(~bad)
        require_views(table.views, images.name)
        lens_fit, table = _lens(table, lens, prior, images.size, model)
        poses = board_poses(table, lens_fit.lens, prior.shape)

    progress("mounting")
    try:
        mounting = find_mounting(chain_forward(chain, images.q), poses, images.camera_on_tip)
        require_near_arm(mounting, chain, images.name)
    except BadRecording as error:
        posed = partial(board_poses, shape=prior.shape)
        raise explained(error, chain, images.q, table, lens_fit.lens, posed, images.camera_on_tip) from error
    far = mounting.off_m > max(_NOWHERE * chain.reach(), _NOWHERE_TIMES * float(np.median(mounting.off_m)))
    if far.any() and (~far).sum() >= MIN_VIEWS:
        left_out |= {n: _ELSEWHERE for n, f in zip(table.names, far, strict=True) if f}
        table, images = table.select(~far), images.select(~far)
    return images, table, lens_fit, prior, mounting, left_out


def first_fit(ready: PreparedImages, arm: float | None) -> tuple[CameraFit, PreparedImages]:
    """(a fit, what it was made from): what is nowhere near the arm is left out. arm: as of a fit."""
    if ready.table.places:
        return _first_fit_of_body(ready, arm)
    fit = fit_camera(ready.table, ready.poses, ready.lens_fit.lens, ready.prior, arm=arm)
    strange = strangers(fit)
    if strange.any() and (~strange).sum() >= MIN_VIEWS:
        ready = ready.select(~strange, _ELSEWHERE)
        fit = fit_camera(ready.table, ready.poses, ready.lens_fit.lens, ready.prior, fit.sizes, arm=arm)
    return fit, ready


def require_near_arm(mounting: Mounting, chain: Chain, name: str) -> None:
    """Raises BadRecording for images that miss the arm's motion by more than any arm is built wrong."""
    if mounting.misfit_m > _APART_OF_REACH * max(chain.reach(), 0.3):
        said = f"they are {1e3 * mounting.misfit_m:.0f} mm off the arm's motion in the median"
        remedy = "check that each row of joints belongs to its image, joint units and order, and the square's size"
        raise BadRecording(name, said, remedy)


def repeated(views: Sequence[BoardView]) -> dict[int, str]:
    """Which views have the very corners of an earlier one, noise and all, and its name: the camera hung, or a copy."""
    first: dict[bytes, int] = {}
    same = [first.setdefault(v.ids.tobytes() + v.pixels.tobytes(), i) for i, v in enumerate(views)]
    return {i: views[j].name for i, j in enumerate(same) if i != j and len(views[i])}


def require_views(count: int, name: str) -> None:
    """Raises NotEnoughData for fewer images of the target than a mounting needs."""
    if count < MIN_VIEWS:
        said = f"{count} show enough of the target, at least {MIN_VIEWS} are needed"
        raise NotEnoughData(name, said, "take more images, the whole target sharp and in view")


def _lens(
    table: CornerTable, lens: Lens | None, prior: CommonPrior, size: tuple[int, int], model: str
) -> tuple[LensFit, CornerTable]:
    """The lens from the images alone, and the corners with those left out that fit no pose."""
    start = Lens(prior.mean[:LENS], size, model) if lens is None else lens
    information = prior.information[:LENS, :LENS]
    shape = np.zeros(SHAPE)
    for _ in range(3):
        fit = fit_lens(table, start, prior.free[:LENS], information)
        weight = corner_weights(table, fit.lens, shape, fit.T_camera_target)
        if (weight == table.weight).all():
            break
        table = table.with_weight(weight)
    return fit, table


_GROSS = 10.0  # times the median distance from where corners should be: errors that are no one's share never reach it
_CLEANED = 5  # times that points and images are looked through


def _of_body(chain: Chain, images: CameraImages, progress: Callable[[str], None]) -> _Seen:
    """Every image counts, whether or not it shows a pose by itself."""
    target, lens = images.target, images.lens
    assert isinstance(target, MarkerBundle)
    keep = np.array([len(v) > 0 for v in images.views], dtype=bool)
    left_out = {v.name: "no point of the target" for v, k in zip(images.views, keep, strict=True) if not k}
    images = images.select(keep)
    require_views(len(images.views), images.name)
    table = CornerTable.of(images.views, target)

    progress("mounting")
    model = FISHEYE if images.fisheye else PINHOLE
    usual = lens or Lens.plain(float(max(images.size)), images.size, model)  # for what hardly depends on it
    require_order(table, usual, target)
    try:
        A = chain_forward(chain, images.q)
        begin = start_of_body(table, A, lens, images.size, model, images.camera_on_tip)
        mounting = begin.mounting
        require_near_arm(mounting, chain, images.name)
    except BadRecording as error:
        whole = images_with_pose(table)
        if whole.sum() < MIN_VIEWS:
            raise
        some = table.select(whole), usual, body_poses, images.camera_on_tip
        raise explained(error, chain, images.q[whole], *some) from error
    prior = common_prior(begin.lens, target.scale, images.stated if lens is not None else None)
    prior = prior.with_places(target.place_prior())
    far = _gross(residuals(table, begin.lens, table.unshaped, mounting.T_camera_target))
    strange = mostly_out(table, far)
    if strange.any():
        left_out |= {n: _ELSEWHERE for n, s in zip(table.names, strange, strict=True) if s}
        far = far[~strange[table.view]]
        table, images = table.select(~strange), images.select(~strange)
        mounting = replace(mounting, T_camera_target=mounting.T_camera_target[~strange])
        require_views(table.views, images.name)
    table = table.with_weight(np.where(far, 0.0, 1.0))
    unfitted = LensFit(begin.lens, mounting.T_camera_target, np.nan, np.nan, np.zeros((LENS, LENS)), True)
    return images, table, unfitted, prior, mounting, left_out


def _first_fit_of_body(ready: PreparedImages, arm: float | None) -> tuple[CameraFit, PreparedImages]:
    """(a fit, what it was made from): points that are misread and images taken elsewhere are left out. arm: as of a
    fit.
    """
    lens, prior = ready.lens_fit.lens, ready.prior
    ready, fit, far = _without_gross(ready, arm)
    fit = fit_camera(ready.table, ready.poses, lens, prior, arm=arm, begin=fit.state)
    cleaned = False
    for _ in range(_CLEANED):
        more = far_markers(fit) & ~far
        far |= more
        weight = np.where(far[ready.table.marker], 0.0, point_weights(fit))
        strange = mostly_out(ready.table, weight == 0.0)
        if (weight == ready.table.weight).all() and not strange.any():
            strange = elsewhere(fit)  # not before misread points are out, which draw their image away
            if not strange.any():
                break
        if (~strange).sum() < MIN_VIEWS:
            break
        ready = replace(ready, table=ready.table.with_weight(weight))
        if strange.any():
            ready = ready.select(~strange, _ELSEWHERE)
        # the sizes of errors hardly change but for a marker that was far off, and take most of the time
        fit = fit_camera(
            *(ready.table, ready.poses, lens, prior, fit.sizes), arm=arm, fixed_sizes=not more.any(), begin=fit.state
        )
        cleaned = True
    if cleaned:
        fit = fit_camera(*(ready.table, ready.poses, lens, prior, fit.sizes), arm=arm, begin=fit.state)
    return fit, ready


def _without_gross(ready: PreparedImages, arm: float | None) -> tuple[PreparedImages, CameraFit, np.ndarray]:
    """(the images without what is grossly elsewhere, a fit of them with errors as large as usual, markers (K,) that are
    far off): one such image, or marker, would make all errors look as large as its own.
    """
    begin = None
    markers = np.zeros(ready.table.markers, bool)
    for _ in range(_CLEANED):
        fit = fit_camera(
            *(ready.table, ready.poses, ready.lens_fit.lens, ready.prior), arm=arm, fixed_sizes=True, begin=begin
        )
        begin = fit.state
        markers |= far_markers(fit)
        far = _gross(fit.pixels) | markers[ready.table.marker]
        strange = mostly_out(ready.table, far)
        weight = np.where(far, 0.0, 1.0)
        if (~strange).sum() < MIN_VIEWS or (not strange.any() and (weight == ready.table.weight).all()):
            break
        ready = replace(ready, table=ready.table.with_weight(weight))
        if strange.any():
            ready = ready.select(~strange, _ELSEWHERE)
    return ready, fit, markers


def _gross(off: Array) -> np.ndarray:
    """Which corners (M,) have residuals (M, 2) above a multiple of the median."""
    size = np.linalg.norm(off, axis=1)
    return np.asarray(size > _GROSS * float(np.median(size)))

"""Images of a camera made ready for a fit, and fitted first, without what is not where it should be.

Of a sheet every image shows a pose, and the lens is fitted to these before the arm is asked. An image of a body may
show three points, which fit any pose, so its points are held against the arm: those that are off by far more than the
others are out, and where most of an image is, the image. A marker most of whose points are out has another number, or
another place, than the target's file states, or came loose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import Model, exceeded_chi2, median_chi2
from modcal_core.camera.arm_poses import ArmPoses, with_parameters, with_stated
from modcal_core.camera.bundle import MarkerBundle
from modcal_core.camera.corners import (
    POSE,
    SHAPE,
    CameraState,
    CommonPrior,
    CornerTable,
    common_prior,
    corner_rows,
    enough_corners,
    images_with_pose,
)
from modcal_core.camera.equations import numbered
from modcal_core.camera.fit import START, Camera, CameraFit, CameraImages, Cameras, fit_cameras
from modcal_core.camera.lens import COUNT as LENS
from modcal_core.camera.lens import FISHEYE, PINHOLE, Lens
from modcal_core.camera.mounting import (
    ENOUGH,
    MIN_VIEWS,
    BoardPose,
    Mounting,
    board_poses,
    explained,
    find_mounting,
    first_lens,
    fit_lens,
    lens_by_arm,
    require_order,
)
from modcal_core.effects import NominalArm
from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.geometry import Array
from modcal_core.robots import Chain, Inertias, chain_forward


def together(cameras: Sequence[CameraImages]) -> list[CameraImages]:
    """The same images with what cameras share: whether a body's corners are read, and a number for images that were
    taken at one stop of the arm. Raises BadTable for a body of which too little was seen.
    """
    out = list(cameras)
    for k, one in enumerate(out):
        if isinstance(one.target, MarkerBundle):
            ids = [v.ids for other in cameras if other.target == one.target for v in other.views]
            seen = np.unique(np.concatenate([np.empty(0, int), *ids])).astype(int)
            out[k] = replace(one, target=one.target.seen_by(seen))
    if len(out) == 1:
        return out
    names = [[v.name for v in one.views] for one in out]
    stops = numbered([one.q for one in out], names, [one.moments.stamps for one in out])
    return [replace(one, moments=replace(one.moments, stop=stop)) for one, stop in zip(out, stops, strict=True)]


_NOWHERE, _NOWHERE_TIMES = 0.1, 10.0  # of the reach, and of the others' misfit: an image of elsewhere, or turned round
_APART_OF_REACH = 0.03  # misfit of images and arm, as a share of the reach: no arm is built that badly
_TO_SIGMA = 1.4826  # of a median absolute deviation, for normal errors
_CORNER = 6.0  # robust standard deviations: one good corner in a billion
_CORNER_PX = 0.1  # where printers put a square's corner: 0.03 mm, in an image of a third of a millimetre a pixel
_IMAGE_PX, _IMAGE_TIMES = 1.0, 5.0  # RMS of an image that is blurred or misread: more than a pixel, and than the others
MOSTLY = 0.5  # of the points of an image, or of a marker, beyond which it is not where it should be; or of an error
_GROSS = 10.0  # times the median distance from where corners should be: errors that are no one's share never reach it
ELSEWHERE = "far from where the arm has it"


def fitted(camera: Camera, last: CameraFit | None = None, fixed_sizes: bool = False) -> CameraFit:
    """A fit of one camera. last: one to begin with. fixed_sizes: take the sizes of errors as they are there."""
    begin, sizes = (None, START) if last is None else (last.x, last.sizes)
    return fit_cameras(Cameras((camera,)), begin, sizes, fixed_sizes)


def nominal(camera: Camera) -> CameraFit:
    """A fit of camera and target to these images, the arm held nominal."""
    poses = camera.poses.nominal
    return fitted(replace(camera, poses=poses, begin=replace(camera.begin, values=poses.values.start)))


@dataclass(frozen=True)
class _Kept:
    """Images in use: their numbers among all, their corners, and those left out, by reason. name: of the camera."""

    name: str
    rows: np.ndarray
    table: CornerTable
    left_out: dict[str, str]

    def without(self, whys: Sequence[str] | np.ndarray) -> _Kept:
        """Without the images (N,) of which it is said why. Raises NotEnoughData."""
        keep = np.array([not why for why in whys], dtype=bool)
        if keep.sum() < MIN_VIEWS:
            said = f"{int(keep.sum())} show enough of the target, at least {MIN_VIEWS} are needed"
            raise NotEnoughData(self.name, said, "take more images, the whole target sharp and in view")
        out = {name: why for name, why in zip(self.table.names, whys, strict=True) if why}
        return _Kept(self.name, self.rows[keep], self.table.select(keep), self.left_out | out)


_Start = tuple[_Kept, Lens, CommonPrior, Mounting]


def prepare_images(
    chain: Chain,
    images: CameraImages,
    fixed: Sequence[str] = (),
    inertias: Inertias | None = None,
    arm_m: float | None = None,
) -> Camera:
    """The images of one camera, ready for a fit.

    fixed: parameters that stay as they are. arm_m: RMS error of the nominal arm, as stated [m]. Raises ModcalError for
    images that cannot carry a fit.
    """
    kept = _Kept(images.name, np.arange(len(images.views)), CornerTable.of(images.views, images.target), {})
    kept, lens, prior, mounting = (_of_body if kept.table.places else _of_sheet)(chain, images, kept)
    q, on_tip = images.q[kept.rows], mounting.camera_on_tip
    velocity = np.zeros_like(q) if images.velocity is None else images.velocity[kept.rows]
    base, tool, arm = mounting.T_frame_base[None], mounting.T_tip_tool, NominalArm(chain, inertias)
    model = Model(chain, ("target" if on_tip else "camera",), base, tool, arm=arm)
    poses = with_parameters(ArmPoses(model, (), q, velocity, on_tip, images.moments.select(kept.rows)), fixed)
    poses, common = with_stated(poses, arm_m), np.r_[lens.values, prior.mean[LENS:]]
    begin = CameraState(poses.values.start, 0.0, common, lens)
    return Camera(images, mounting, kept.table, poses, prior, begin, kept.left_out)


def _of_sheet(chain: Chain, images: CameraImages, kept: _Kept) -> _Start:
    """The lens from the images alone, and the mounting by the poses that they show."""
    target, stated, first = images.target, images.lens, dict[bytes, int]()
    whys = []
    for i, v in enumerate(images.views):
        same = first.setdefault(v.ids.tobytes() + v.pixels.tobytes(), i)  # the very corners, noise and all
        said = f"the same picture as {images.views[same].name}: the camera hung, or it was copied"
        whys.append("" if same == i else said)
        if not enough_corners(target.points[v.ids]):
            whys[-1] = "too few corners of the target"
    kept = kept.without(whys)
    model = FISHEYE if images.fisheye else PINHOLE
    lens = stated or first_lens(kept.table, images.size, model)
    prior = common_prior(lens, target, images.stated if stated is not None else None, images.flat)
    lens = stated or Lens(prior.mean[:LENS], images.size, model)
    for _ in range(_CLEANED):
        fit = fit_lens(kept.table, lens, prior.free[:LENS], prior.information[:LENS, :LENS])
        rows = corner_rows(kept.table, fit.lens, np.zeros(SHAPE), fit.T_camera_target)
        weight = np.where(agreeing(kept.table, rows.residual, rows.pixels), kept.table.weight, 0.0)
        table = replace(kept.table, weight=weight)
        poses = board_poses(table, fit.lens, prior.shape)
        blurred = poses.rms > max(_IMAGE_PX, _IMAGE_TIMES * float(np.median(poses.rms)))
        bad = blurred | ~images_with_pose(table)
        if (weight == kept.table.weight).all() and not bad.any():
            break
        kept = replace(kept, table=table).without(np.where(bad, "the target fits this image badly", ""))
    mounting = _mounting(chain, images, images.q[kept.rows], poses)
    far = mounting.off_m > max(_NOWHERE * chain.reach(), _NOWHERE_TIMES * float(np.median(mounting.off_m)))
    if (~far).sum() >= MIN_VIEWS:
        kept = kept.without(np.where(far, ELSEWHERE, ""))
    return kept, fit.lens, prior, mounting


def _of_body(chain: Chain, images: CameraImages, kept: _Kept) -> _Start:
    """Every image counts, whether or not it shows a pose by itself."""
    target, lens = images.target, images.lens
    assert isinstance(target, MarkerBundle)
    kept = kept.without(["" if len(v) else "no point of the target" for v in images.views])
    # for what hardly depends on it
    usual = lens or Lens.plain(float(max(images.size)), images.size, FISHEYE if images.fisheye else PINHOLE)
    table, q = kept.table, images.q[kept.rows]
    require_order(table, usual, target)
    whole, A = images_with_pose(table), chain_forward(chain, q)
    if whole.sum() < ENOUGH:
        said = f"{whole.sum()} of {table.views} show four points of the body that tell a pose, {ENOUGH} are needed"
        raise NotEnoughData("images", said, "take more images, or such as show more of its points")
    posed = table.select(whole)
    lens = lens or lens_by_arm(posed, A[whole], usual, images.camera_on_tip)
    mounting = _mounting(chain, images, q[whole], board_poses(posed, lens)).by_arm(A)
    prior = common_prior(lens, target, images.stated if images.lens is not None else None)
    far = gross(corner_rows(table, lens, np.zeros(SHAPE), mounting.T_camera_target).pixels)
    kept = replace(kept, table=replace(table, weight=np.where(far, 0.0, 1.0)))
    kept = kept.without(np.where(mostly_out(table, far), ELSEWHERE, ""))
    return kept, lens, prior, mounting


def _mounting(chain: Chain, images: CameraImages, q: Array, poses: BoardPose) -> Mounting:
    """The mounting by images with poses, the arm at q (N, n). Raises BadRecording for images that miss the arm's motion
    by more than any arm is built wrong, with what was written down wrongly where that is beyond doubt.
    """
    try:
        mounting = find_mounting(chain_forward(chain, q), poses, images.camera_on_tip)
        if mounting.misfit_m > _APART_OF_REACH * max(chain.reach(), 0.3):
            said = f"they are {1e3 * mounting.misfit_m:.0f} mm off the arm's motion in the median"
            remedy = (
                "check that each row of joints belongs to its image, joint units and order, the square's size, and "
                "that u counts from the left and v from the top"
            )
            raise BadRecording(images.name, said, remedy)
    except BadRecording as error:
        raise explained(error, chain, q, poses, images.camera_on_tip) from error
    return mounting


def agreeing(table: CornerTable, residual: Array, pixels: Array | None = None) -> np.ndarray:
    """Corners (M,) whose whitened residuals (M, 2) are like those of the corners in use, or of no pixels at all."""
    size = np.abs(residual)
    sigma = max(_TO_SIGMA * float(np.median(size[table.weight > 0.0])), 1e-9)
    near = size <= _CORNER * sigma
    return np.asarray((near if pixels is None else near | (np.abs(pixels) <= _CORNER_PX)).all(axis=1))


def gross(off: Array) -> np.ndarray:
    """Which corners (M,) have residuals (M, 2) above a multiple of the median."""
    size = np.linalg.norm(off, axis=1)
    return np.asarray(size > _GROSS * float(np.median(size)))


def mostly_out(table: CornerTable, out: np.ndarray) -> np.ndarray:
    """Images (N,) most of whose points (mask (M,)) are out."""
    count = np.bincount(table.view, minlength=table.views)
    return np.asarray(np.bincount(table.view, out.astype(float), table.views) > MOSTLY * count)


_VIEW_CHANCE = 1e-7  # of an image as far off as this, were it like the others
_SEEN = 1e-9  # of an image's information; directions below it are none that it shows
# Tolerances, and times the median marker, that a marker's place may differ from where the others have it: farther is
# another marker's sighting under its number, or a slip of the pen, which would make all places look as open as its own.
_FAR = 6.0
_CLEANED = 5  # times that points and images are looked through


def view_distances(fit: CameraFit) -> tuple[Array, np.ndarray]:
    """Squared distances (N,) of images' poses from the arm's, in deviations; along how many directions (N,)."""
    G = fit.equations.cameras[0].grams[:, :POSE] / fit.sizes.noise**2
    inner, score = G[:, :, :POSE], G[:, :, -1:]
    scale = 1.0 / np.sqrt(np.maximum(np.einsum("nii->ni", inner), 1e-300))
    scale = scale[:, :, None] * scale[:, None]
    inverse = np.linalg.pinv(scale * inner, _SEEN, hermitian=True) * scale
    # by how much an image's own twist, as free as it may be, lowers its cost, less what its likeliest one does
    square = np.swapaxes(score, 1, 2) @ (inverse - fit.equations.solve(fit.sizes).S) @ score
    return square[:, 0, 0], np.rint(np.einsum("nij,nji->n", inverse, inner)).astype(int)


def elsewhere(fit: CameraFit) -> np.ndarray:
    """Images (N,) that are nowhere near where the arm has them, the others' scatter being the scale."""
    square, rank = view_distances(fit)
    usual = np.array([1.0, *(median_chi2(r) for r in range(1, POSE + 1))])[rank]
    most = np.array([np.inf, *(exceeded_chi2(_VIEW_CHANCE, r) for r in range(1, POSE + 1))])[rank]
    scale = max(float(np.median((square / usual)[rank > 0])), 0.1) if rank.any() else np.inf
    return np.asarray(square > scale * most)


def misread_points(fit: CameraFit) -> np.ndarray:
    """Points (M,) that are not where the fit has them, each image's own error taken out."""
    table = fit.table
    rows = corner_rows(table, fit.state.lens, fit.state.shape, fit.poses.seen(fit.tool), fit.state.readout_s)
    G = fit.equations.cameras[0].grams / fit.sizes.noise**2
    own = (fit.equations.solve(fit.sizes).S @ G[:, :POSE, -1:])[:, :, 0]  # its twist, as likely as it is
    residual = rows.residual - (rows.by_pose @ own[table.view][:, :, None])[:, :, 0]
    return ~agreeing(table, residual)


def far_markers(fit: CameraFit) -> np.ndarray:
    """Markers (K,) whose place is not where any hand would have glued them, the median marker being the scale."""
    table, prior = fit.table, fit.cameras.first.prior.places
    assert prior is not None
    off = (prior.white @ fit.state.shape[SHAPE:].reshape(table.markers, -1, 1))[:, :, 0]
    size, used = np.sqrt((off**2).mean(axis=1)), np.bincount(table.marker, table.weight, table.markers) > 0.0
    return np.asarray(used & (size > _FAR * max(1.0, float(np.median(size[used])))))


def first_fit(camera: Camera) -> CameraFit:
    """A fit of one camera: misread points of a body, and images nowhere near the arm, are left out.

    The sizes of errors stay usual until what is grossly elsewhere is out, for one such image or marker would make all
    errors look as large as its own.
    """
    body, far, last = camera.table.places > 0, np.zeros(camera.table.markers, bool), None
    for usual_sizes in (True, False) if body else (False,):
        for _ in range(_CLEANED if body else 1):
            fit = fitted(camera, last, fixed_sizes=usual_sizes)
            out = fit.table.weight == 0.0
            if body:
                far |= far_markers(fit)
                out = (gross(fit.pixels) if usual_sizes else misread_points(fit)) | far[fit.table.marker]
            last = replace(fit, sizes=START) if usual_sizes else fit
            again = _without(camera, out, None if usual_sizes else fit)
            if again is None:
                break
            camera = again
    return fit if again is None else fitted(camera, fit)


def _without(camera: Camera, out: np.ndarray, fit: CameraFit | None = None) -> Camera | None:
    """The images without these points (M,) and without those most of whose points they are; None if nothing changes,
    or too little is left. fit: where points are as they were, without images that are elsewhere by it.
    """
    table, weight = camera.table, np.where(out, 0.0, 1.0)
    strange = mostly_out(table, out) if table.places else np.zeros(table.views, bool)
    if (weight == table.weight).all() and not strange.any():
        # not before misread points are out, which draw their image away
        strange = strange if fit is None else elsewhere(fit)
        if not strange.any():
            return None
    if (~strange).sum() < MIN_VIEWS:
        return None
    out_now = {name: ELSEWHERE for name, far in zip(table.names, strange, strict=True) if far}
    kept = replace(camera, table=replace(table, weight=weight), left_out=camera.left_out | out_now)
    return kept.select(~strange)

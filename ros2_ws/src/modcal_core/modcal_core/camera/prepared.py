"""The images of one camera, made ready for a fit: its lens, the target's pose in each image, mounting, the start."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from modcal_core.calibration.parameters import ModelParameter
from modcal_core.camera.arm_poses import ArmPoses, arm_poses
from modcal_core.camera.clean import bad_images, corner_weights, enough_corners, strangers
from modcal_core.camera.corners import SHAPE, CornerTable
from modcal_core.camera.fit import CameraFit, fit_camera
from modcal_core.camera.intrinsics import LensFit, first_lens, fit_lens
from modcal_core.camera.lens import COUNT as LENS
from modcal_core.camera.lens import FISHEYE, PINHOLE, Lens
from modcal_core.camera.mismatched import explained
from modcal_core.camera.moments import NOTHING_KNOWN, ImageMoments
from modcal_core.camera.mounting import MIN_VIEWS, Mounting, find_mounting
from modcal_core.camera.pnp import board_poses
from modcal_core.camera.priors import FREE, CommonPrior, common_prior
from modcal_core.camera.target import CalibrationTarget
from modcal_core.camera.views import BoardView
from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import forward
from modcal_core.robots.urdf_inertias import Inertias

_NOWHERE, _NOWHERE_TIMES = 0.1, 10.0  # of the reach, and of the others' misfit: an image of elsewhere, or turned round
_STRANGE = "far from where the arm has it"
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


@dataclass(frozen=True)
class PreparedImages:
    """table: the corners. poses: the nominal arm at the images, base and tool as found. placed: parameters of these
    alone. lens_fit: from the images alone. prior: of lens and sheet. mounting: as found. left_out: images by reason.
    """

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


def prepare(
    chain: Chain,
    images: CameraImages,
    fixed: Sequence[str] = (),
    inertias: Inertias | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> PreparedImages:
    """The images of one camera, ready for a fit.

    fixed: parameters that stay as they are. Raises ModcalError for images that cannot carry a fit.
    """
    q, views, target, lens = images.q, images.views, images.target, images.lens
    velocity = np.zeros_like(q) if images.velocity is None else images.velocity
    keep = np.array([enough_corners(target.points[v.ids]) for v in views], dtype=bool)
    left_out = {v.name: "too few corners of the target" for v, k in zip(views, keep, strict=True) if not k}
    for i, name in repeated(views).items():
        keep[i], left_out[views[i].name] = False, f"the same picture as {name}: the camera hung, or it was copied"
    require_views(int(keep.sum()), images.name)
    table = CornerTable.of([v for v, k in zip(views, keep, strict=True) if k], target)
    q, velocity, moments = q[keep], velocity[keep], images.moments.select(keep)

    progress("lens")
    model = FISHEYE if images.fisheye else PINHOLE
    start = lens or first_lens(table, images.size, model)
    prior = common_prior(start, target.scale, images.stated if lens is not None else None, images.flat)
    lens_fit, table = _lens(table, lens, prior, images.size, model)
    poses = board_poses(table, lens_fit.lens, prior.shape)
    if (bad := bad_images(table, poses.rms)).any():
        left_out |= {n: "the target fits this image badly" for n, b in zip(table.names, bad, strict=True) if b}
        table, q, velocity, moments = table.select(~bad), q[~bad], velocity[~bad], moments.select(~bad)
        require_views(table.views, images.name)
        lens_fit, table = _lens(table, lens, prior, images.size, model)
        poses = board_poses(table, lens_fit.lens, prior.shape)

    progress("mounting")
    try:
        mounting = find_mounting(forward(chain, q), poses, images.camera_on_tip)
        require_near_arm(mounting, chain, images.name)
    except BadRecording as error:
        posed = partial(board_poses, shape=prior.shape)
        raise explained(error, chain, q, table, lens_fit.lens, posed, images.camera_on_tip) from error
    at = (chain, q, velocity, mounting.T_frame_base, mounting.T_tip_tool, mounting.camera_on_tip, fixed)
    ready = PreparedImages(
        table,
        arm_poses(*at, moments=moments, inertias=inertias),
        arm_poses(*at, hand_eye_only=True).parameters,
        lens_fit,
        prior,
        mounting,
        left_out,
    )
    far = mounting.off_m > max(_NOWHERE * chain.reach(), _NOWHERE_TIMES * float(np.median(mounting.off_m)))
    return ready.select(~far, _STRANGE) if far.any() and (~far).sum() >= MIN_VIEWS else ready


def first_fit(ready: PreparedImages, arm: float | None) -> tuple[CameraFit, PreparedImages]:
    """(a fit, what it was made from): images that are nowhere near the arm are left out. arm: as of a fit."""
    fit = fit_camera(ready.table, ready.poses, ready.lens_fit.lens, ready.prior, arm=arm)
    strange = strangers(fit)
    if strange.any() and (~strange).sum() >= MIN_VIEWS:
        ready = ready.select(~strange, _STRANGE)
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

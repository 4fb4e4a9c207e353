"""The images of one camera, made ready for a fit: its lens, the target's pose in each image, mounting, the start."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from modcal_core.camera.arm_poses import arm_poses
from modcal_core.camera.body_start import body_poses, images_with_pose, require_order, start_of_body
from modcal_core.camera.bundle import BoardView, MarkerBundle
from modcal_core.camera.corners import SHAPE, CommonPrior, CornerTable, common_prior, corner_rows
from modcal_core.camera.images import CameraImages, PreparedImages
from modcal_core.camera.intrinsics import LensFit, board_poses, first_lens, fit_lens
from modcal_core.camera.lens import COUNT as LENS
from modcal_core.camera.lens import FISHEYE, PINHOLE, Lens
from modcal_core.camera.mounting import MIN_VIEWS, Mounting, explained, find_mounting
from modcal_core.camera.outliers import (
    ELSEWHERE,
    bad_images,
    corner_weights,
    enough_corners,
    gross,
    mostly_out,
)
from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.robots import Chain, Inertias, chain_forward

_NOWHERE, _NOWHERE_TIMES = 0.1, 10.0  # of the reach, and of the others' misfit: an image of elsewhere, or turned round
_APART_OF_REACH = 0.03  # misfit of images and arm, as a share of the reach: no arm is built that badly


@dataclass(frozen=True)
class _Seen:
    """Images, the corners in them, and images that are left out, by reason."""

    images: CameraImages
    table: CornerTable
    left_out: dict[str, str]

    @classmethod
    def of(cls, images: CameraImages, left_out: dict[int, str]) -> _Seen:
        """Without some of the images, by their index. Raises NotEnoughData."""
        keep = np.array([i not in left_out for i in range(len(images.views))], dtype=bool)
        some = images.select(keep)
        require_views(len(some.views), images.name)
        return cls(
            some, CornerTable.of(some.views, images.target), {images.views[i].name: w for i, w in left_out.items()}
        )

    def without(self, bad: np.ndarray, why: str) -> _Seen:
        """Without these images (N,). Raises NotEnoughData."""
        if not bad.any():
            return self
        require_views(int((~bad).sum()), self.images.name)
        out = {name: why for name, b in zip(self.table.names, bad, strict=True) if b}
        return _Seen(self.images.select(~bad), self.table.select(~bad), self.left_out | out)


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
    seen, lens_fit, prior, mounting = look(chain, images, progress)
    q = seen.images.q
    velocity = np.zeros_like(q) if seen.images.velocity is None else seen.images.velocity
    at = (chain, q, velocity, mounting.T_frame_base, mounting.T_tip_tool, mounting.camera_on_tip, fixed)
    poses = arm_poses(*at, moments=seen.images.moments, inertias=inertias)
    return PreparedImages(images, seen.table, poses, lens_fit, prior, mounting, seen.left_out)


_Start = tuple[_Seen, LensFit, CommonPrior, Mounting]


def _of_sheet(chain: Chain, images: CameraImages, progress: Callable[[str], None]) -> _Start:
    target, lens = images.target, images.lens
    few = "too few corners of the target"
    left_out = {i: few for i, v in enumerate(images.views) if not enough_corners(target.points[v.ids])}
    twice = repeated(images.views).items()
    left_out |= {i: f"the same picture as {name}: the camera hung, or it was copied" for i, name in twice}
    seen = _Seen.of(images, left_out)

    progress("lens")
    model = FISHEYE if images.fisheye else PINHOLE
    start = lens or first_lens(seen.table, images.size, model)
    prior = common_prior(start, target.scale, images.stated if lens is not None else None, images.flat)
    start = Lens(prior.mean[:LENS], images.size, model) if lens is None else lens
    for first in (True, False):  # once more without images that the target fits badly
        lens_fit, table = _lens(seen.table, start, prior)
        poses = board_poses(table, lens_fit.lens, prior.shape)
        bad = bad_images(table, poses.rms)
        seen = replace(seen, table=table)
        if not (first and bad.any()):
            break
        seen = seen.without(bad, "the target fits this image badly")

    progress("mounting")
    q = seen.images.q
    try:
        mounting = find_mounting(chain_forward(chain, q), poses, images.camera_on_tip)
        require_near_arm(mounting, chain, images.name)
    except BadRecording as error:
        posed = partial(board_poses, shape=prior.shape)
        raise explained(error, chain, q, seen.table, lens_fit.lens, posed, images.camera_on_tip) from error
    far = mounting.off_m > max(_NOWHERE * chain.reach(), _NOWHERE_TIMES * float(np.median(mounting.off_m)))
    if (~far).sum() >= MIN_VIEWS:
        seen = seen.without(far, ELSEWHERE)
    return seen, lens_fit, prior, mounting


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


def _lens(table: CornerTable, start: Lens, prior: CommonPrior) -> tuple[LensFit, CornerTable]:
    """The lens from the images alone, and the corners with those left out that fit no pose."""
    for _ in range(3):
        fit = fit_lens(table, start, prior.free[:LENS], prior.information[:LENS, :LENS])
        weight = corner_weights(table, fit.lens, np.zeros(SHAPE), fit.T_camera_target)
        if (weight == table.weight).all():
            break
        table = table.with_weight(weight)
    return fit, table


def _of_body(chain: Chain, images: CameraImages, progress: Callable[[str], None]) -> _Start:
    """Every image counts, whether or not it shows a pose by itself."""
    target, lens = images.target, images.lens
    assert isinstance(target, MarkerBundle)
    seen = _Seen.of(images, {i: "no point of the target" for i, v in enumerate(images.views) if not len(v)})

    progress("mounting")
    model = FISHEYE if images.fisheye else PINHOLE
    usual = lens or Lens.plain(float(max(images.size)), images.size, model)  # for what hardly depends on it
    table, q = seen.table, seen.images.q
    require_order(table, usual, target)
    try:
        begin = start_of_body(table, chain_forward(chain, q), lens, usual, images.camera_on_tip)
        mounting = begin.mounting
        require_near_arm(mounting, chain, images.name)
    except BadRecording as error:
        whole = images_with_pose(table)
        if whole.sum() < MIN_VIEWS:
            raise
        some = table.select(whole), usual, body_poses, images.camera_on_tip
        raise explained(error, chain, q[whole], *some) from error
    prior = common_prior(begin.lens, target.scale, images.stated if lens is not None else None)
    prior = prior.with_places(target.place_prior())
    far = gross(corner_rows(table, begin.lens, table.unshaped, mounting.T_camera_target).pixels)
    seen = replace(seen, table=table.with_weight(np.where(far, 0.0, 1.0)))
    strange = mostly_out(table, far)
    seen = seen.without(strange, ELSEWHERE)
    mounting = replace(mounting, T_camera_target=mounting.T_camera_target[~strange])
    unfitted = LensFit(begin.lens, mounting.T_camera_target, np.nan, np.nan, np.zeros((LENS, LENS)), True)
    return seen, unfitted, prior, mounting

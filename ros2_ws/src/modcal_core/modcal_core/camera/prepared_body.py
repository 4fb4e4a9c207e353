"""The images of a body made ready for a fit, as those of a sheet are (prepared), and the first fit of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from modcal_core.camera.arm_poses import arm_poses
from modcal_core.camera.body_start import (
    body_poses,
    default_lens,
    elsewhere,
    far_markers,
    images_with_pose,
    mostly_out,
    point_weights,
    require_order,
    start_of_body,
)
from modcal_core.camera.bundle import MarkerBundle
from modcal_core.camera.corners import CornerTable, residuals
from modcal_core.camera.fit import CameraFit, fit_camera
from modcal_core.camera.intrinsics import LensFit
from modcal_core.camera.lens import COUNT as LENS
from modcal_core.camera.lens import FISHEYE, PINHOLE
from modcal_core.camera.mounting import MIN_VIEWS, explained
from modcal_core.camera.prepared import CameraImages, PreparedImages, require_near_arm, require_views
from modcal_core.camera.state import common_prior
from modcal_core.errors import BadRecording
from modcal_core.geometry import Array
from modcal_core.robots import Chain, Inertias, chain_forward

_GROSS = 10.0  # times the median distance from where corners should be: errors that are no one's share never reach it
_CLEANED = 5  # times that points and images are looked through
_ELSEWHERE = "far from where the arm has it"


def prepare_body(
    chain: Chain,
    images: CameraImages,
    target: MarkerBundle,
    fixed: tuple[str, ...] = (),
    inertias: Inertias | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> PreparedImages:
    """The images of a body, ready for a fit; every image counts, whether or not it shows a pose by itself.

    fixed: parameters that stay as they are. Raises ModcalError for images that cannot carry a fit.
    """
    q, views, lens = images.q, images.views, images.lens
    velocity = np.zeros_like(q) if images.velocity is None else images.velocity
    keep = np.array([len(v) > 0 for v in views], dtype=bool)
    left_out = {v.name: "no point of the target" for v, k in zip(views, keep, strict=True) if not k}
    require_views(int(keep.sum()), images.name)
    table = CornerTable.of([v for v, k in zip(views, keep, strict=True) if k], target)
    q, velocity, moments = q[keep], velocity[keep], images.moments.select(keep)

    progress("mounting")
    model = FISHEYE if images.fisheye else PINHOLE
    require_order(table, lens or default_lens(images.size, model), target)
    try:
        begin = start_of_body(table, chain_forward(chain, q), lens, images.size, model, images.camera_on_tip)
        mounting = begin.mounting
        require_near_arm(mounting, chain, images.name)
    except BadRecording as error:
        whole = images_with_pose(table)
        if whole.sum() < MIN_VIEWS:
            raise
        some, used = table.select(whole), lens or default_lens(images.size, model)
        raise explained(error, chain, q[whole], some, used, body_poses, images.camera_on_tip) from error
    prior = common_prior(begin.lens, target.scale, images.stated if lens is not None else None)
    prior = prior.with_places(target.place_prior())
    far = _gross(residuals(table, begin.lens, table.unshaped, mounting.T_camera_target))
    strange = mostly_out(table, far)
    if strange.any():
        left_out |= {n: _ELSEWHERE for n, s in zip(table.names, strange, strict=True) if s}
        rows = ~strange[table.view]
        table, far = table.select(~strange), far[rows]
        q, velocity, moments = q[~strange], velocity[~strange], moments.select(~strange)
        mounting = mounting.with_poses(mounting.T_camera_target[~strange])
        require_views(table.views, images.name)
    table = table.with_weight(np.where(far, 0.0, 1.0))
    at = (chain, q, velocity, mounting.T_frame_base, mounting.T_tip_tool, mounting.camera_on_tip, fixed)
    unfitted = LensFit(begin.lens, mounting.T_camera_target, np.nan, np.nan, np.zeros((LENS, LENS)), True)
    return PreparedImages(
        table,
        arm_poses(*at, moments=moments, inertias=inertias),
        arm_poses(*at, hand_eye_only=True).parameters,
        unfitted,
        prior,
        mounting,
        left_out,
    )


def first_fit_of_body(ready: PreparedImages, arm: float | None) -> tuple[CameraFit, PreparedImages]:
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

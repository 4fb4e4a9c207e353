"""Further cameras of a calibration: each is fitted by itself first, which says whether it serves, then with all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.camera.bundle import MarkerBundle
from modcal_core.camera.changes import what_changed
from modcal_core.camera.corners import BOW, COMMON, READOUT, SCALE
from modcal_core.camera.fit import CameraFit, CameraState, missed_pixels
from modcal_core.camera.further import FurtherCamera, further_cameras, places_of
from modcal_core.camera.mounting import Mounting
from modcal_core.camera.prepared import CameraImages, PreparedImages, first_fit, prepare
from modcal_core.camera.prepared_body import first_fit_of_body, prepare_body
from modcal_core.camera.problems import MANY_OUT, moved_sentence
from modcal_core.camera.stops import numbered
from modcal_core.camera.target import CalibrationTarget
from modcal_core.errors import BadRecording
from modcal_core.geometry import Array
from modcal_core.robots import Chain, Inertias

# --- Images of one camera or several made ready: of a sheet, or of a body with the markers that any camera saw


def only_seen(cameras: Sequence[CameraImages]) -> list[CameraImages]:
    """The same images, bodies with those of their markers only that some camera saw, which all that see it share.

    Raises BadTable for a body of which too little was seen.
    """
    out = []
    for one in cameras:
        if isinstance(one.target, MarkerBundle):
            ids = [v.ids for other in cameras if other.target == one.target for v in other.views]
            target = one.target.of_points(np.unique(np.concatenate([np.empty(0, int), *ids])).astype(int))
            one = replace(one, target=target, views=target.renumbered(one.views, one.target))
        out.append(one)
    return out


def with_stops(cameras: Sequence[CameraImages]) -> list[CameraImages]:
    """The same images, those of several cameras that were taken at one stop of the arm numbered as such."""
    if len(cameras) == 1:
        return list(cameras)
    stops = numbered(
        [one.q for one in cameras],
        [[v.name for v in one.views] for one in cameras],
        [one.moments.stamps for one in cameras],
    )
    return [replace(one, moments=replace(one.moments, stop=stop)) for one, stop in zip(cameras, stops, strict=True)]


def prepare_images(
    chain: Chain,
    images: CameraImages,
    fixed: Sequence[str] = (),
    inertias: Inertias | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> PreparedImages:
    """The images of one camera, ready for a fit. Raises ModcalError for images that cannot carry a fit."""
    if isinstance(images.target, MarkerBundle):
        return prepare_body(chain, images, images.target, tuple(fixed), inertias, progress)
    return prepare(chain, images, fixed, inertias, progress)


def begin_fit(ready: PreparedImages, arm: float | None) -> tuple[CameraFit, PreparedImages]:
    """(a fit, what it was made from): what is nowhere near the arm is left out. arm: as of a fit."""
    return first_fit_of_body(ready, arm) if ready.table.places else first_fit(ready, arm)


@dataclass(frozen=True)
class FurtherSeen:
    """A further camera after the fit of all. std: of lens, shape, readout and places, those of the first camera as in
    its fit, (15 + Z,). given: images in which the target was found. rms_px: of its corners.
    """

    name: str
    mounting: Mounting
    target: CalibrationTarget
    state: CameraState
    std: Array
    given: int
    used: int
    left_out: dict[str, str]
    rms_px: float


@dataclass(frozen=True)
class _Further:
    """camera: for the fit of all. problems: what its own images contradict, in sentences."""

    camera: FurtherCamera
    images: CameraImages
    ready: PreparedImages
    problems: tuple[str, ...]

    def seen_by(self, fit: CameraFit) -> FurtherSeen:
        """What the fit of all makes of it."""
        further = further_cameras(fit.poses)
        places = dict(zip((one.name for one in further), places_of(further, fit.poses.count), strict=True))
        camera, first = self.camera, places[self.camera.name]
        state = camera.state(fit.poses, fit.state, fit.state.values[first : first + len(camera.own)])
        columns = camera.columns(fit.poses, first)[len(state.values) + 1 :]
        std = np.where(columns >= 0, np.sqrt(np.diag(fit.covariance))[columns], 0.0)
        gap = missed_pixels(camera.table, camera.poses.with_effects(fit.poses.model.effects), state)
        weight = camera.table.weight
        rms = float(np.sqrt((weight @ (gap**2).sum(1)) / max(weight.sum(), 1.0)))
        ready = self.ready
        return FurtherSeen(
            *(self.images.name, ready.mounting, self.images.target, state, std, len(self.images.views)),
            *(camera.table.views, ready.left_out, rms),
        )


def further_of(
    chain: Chain,
    images: CameraImages,
    first: CameraImages,
    of_first: PreparedImages,
    fixed: Sequence[str],
    inertias: Inertias | None,
    arm: float | None,
) -> _Further:
    """A further camera, from a fit of its own. first, of_first: the first camera. arm: as of a fit.

    Raises ModcalError for images that cannot carry a fit by themselves.
    """
    if images.name == first.name:
        raise BadRecording(images.name, "is given twice", "give each camera once")
    ready = prepare_images(chain, images, fixed, inertias)
    fit, ready = begin_fit(ready, arm)
    same_side = ready.mounting.camera_on_tip == of_first.mounting.camera_on_tip
    out = []
    if not fit.converged:
        out.append(f"The fit of {images.name} by itself did not reach its minimum.")
    moved, focus = what_changed(fit, arm)
    if moved is not None:
        out.append(moved_sentence(fit, moved, f" of {images.name}"))
    if focus is not None:
        out.append(f"{images.name}: {focus.sentence}")
    if len(ready.left_out) > MANY_OUT * len(images.views):
        out.append(f"{len(ready.left_out)} of {len(images.views)} images of {images.name} were left out.")
    camera = _camera(images.name, fit, images.target == first.target, same_side)
    return _Further(camera, images, ready, tuple(out))


def _camera(name: str, fit: CameraFit, same_target: bool, same_side: bool) -> FurtherCamera:
    """From a fit of its own. same_target: of the first camera's file. same_side: carried, or not, as that one."""
    shared = np.zeros(len(fit.prior.mean), bool)
    shared[SCALE] = same_target
    shared[BOW] = same_target and same_side
    shared[COMMON:] = same_target and same_side  # two bodies of one drawing have markers glued each by itself
    moving = bool(fit.equations.free[fit.poses.count])
    prior = replace(fit.prior, free=fit.prior.free & (moving | (np.arange(len(shared)) != READOUT)))
    return FurtherCamera(name, fit.table, fit.poses, prior, fit.state, shared, moving)

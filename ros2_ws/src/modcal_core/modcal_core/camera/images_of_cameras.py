"""Images of one camera or several made ready: of a sheet, or of a body with the markers that any camera saw."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from modcal_core.camera.bundle import MarkerBundle
from modcal_core.camera.fit import CameraFit
from modcal_core.camera.prepared import CameraImages, PreparedImages, first_fit, prepare
from modcal_core.camera.prepared_body import first_fit_of_body, prepare_body
from modcal_core.camera.stops import numbered
from modcal_core.robots.chain import Chain
from modcal_core.robots.urdf_inertias import Inertias


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

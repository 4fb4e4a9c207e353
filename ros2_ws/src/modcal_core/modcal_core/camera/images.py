"""Images of one camera: as they are given, and as a fit takes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.camera.arm_poses import NOTHING_KNOWN, ArmPoses, ImageMoments
from modcal_core.camera.bundle import BoardView, CalibrationTarget, MarkerBundle
from modcal_core.camera.corners import FREE, CommonPrior, CornerTable
from modcal_core.camera.equations import numbered
from modcal_core.camera.fit import START, CameraFit, fit_camera
from modcal_core.camera.intrinsics import LensFit
from modcal_core.camera.lens import Lens
from modcal_core.camera.mounting import Mounting
from modcal_core.geometry import Array


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


def together(cameras: Sequence[CameraImages]) -> list[CameraImages]:
    """The same images with what cameras share: of bodies those markers only that some camera saw, and a number for
    images that were taken at one stop of the arm. Raises BadTable for a body of which too little was seen.
    """
    out = []
    for one in cameras:
        if isinstance(one.target, MarkerBundle):
            ids = [v.ids for other in cameras if other.target == one.target for v in other.views]
            target = one.target.of_points(np.unique(np.concatenate([np.empty(0, int), *ids])).astype(int))
            one = replace(one, target=target, views=target.renumbered(one.views, one.target))
        out.append(one)
    if len(out) == 1:
        return out
    names = [[v.name for v in one.views] for one in out]
    stops = numbered([one.q for one in out], names, [one.moments.stamps for one in out])
    return [replace(one, moments=replace(one.moments, stop=stop)) for one, stop in zip(out, stops, strict=True)]


@dataclass(frozen=True)
class PreparedImages:
    """given: all images. table: corners of those in use. poses: the nominal arm at these, base and tool as found.
    lens_fit: from the images alone. prior: of lens and sheet. mounting: as found. left_out: images by reason.
    """

    given: CameraImages
    table: CornerTable
    poses: ArmPoses
    lens_fit: LensFit
    prior: CommonPrior
    mounting: Mounting
    left_out: dict[str, str]

    def select(self, rows: np.ndarray, why: str) -> PreparedImages:
        """With these images only. why: the others are left out."""
        out = {n: why for n, keep in zip(self.table.names, rows, strict=True) if not keep}
        return replace(self, table=self.table.select(rows), poses=self.poses.select(rows), left_out=self.left_out | out)

    def fitted(self, last: CameraFit | None = None, fixed_sizes: bool = False) -> CameraFit:
        """A fit of these images. last: one to begin with. fixed_sizes: take the sizes of errors as they are there."""
        begin, sizes = (self.lens_fit.lens, START) if last is None else (last.state, last.sizes)
        return fit_camera(self.table, self.poses, self.prior, begin, sizes, fixed_sizes)

    def nominal(self) -> CameraFit:
        """A fit of camera and target to these images, the arm held nominal."""
        still = replace(self.poses, parameters=self.poses.placed, further=(), faults=None)
        return fit_camera(self.table, still, self.prior, self.lens_fit.lens)

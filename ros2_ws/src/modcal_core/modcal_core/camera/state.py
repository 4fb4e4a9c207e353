"""Where a camera fit is: values of the arm's parameters, clock, lens, the sheet's shape, a rolling shutter's time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.camera.corners import COMMON, READOUT, SHAPE
from modcal_core.camera.lens import COUNT as LENS
from modcal_core.camera.lens import Lens
from modcal_core.geometry.so3 import Array


@dataclass(frozen=True)
class CameraState:
    """values: of the arm's parameters, (P,). offset_s: of the clock. lens: as elsewhere. shape: of the target, the
    places of its markers behind it, (5 + Z,). readout_s: in which a rolling shutter goes down an image.
    """

    values: Array
    offset_s: float
    lens: Lens
    shape: Array
    readout_s: float = 0.0

    @property
    def common(self) -> Array:
        """Lens, shape, readout and places of markers, (15 + Z,)."""
        return np.r_[self.lens.values, self.shape[:SHAPE], self.readout_s, self.shape[SHAPE:]]

    def with_common(self, common: Array) -> CameraState:
        """The same with other values of lens, shape, readout and places of markers (15 + Z,)."""
        lens = Lens(common[:LENS], self.lens.size, self.lens.model)
        return replace(self, lens=lens, shape=shape_of(common), readout_s=float(common[READOUT]))

    def moved(self, step: Array) -> CameraState:
        """The state a step (P + 1 + 15 + Z,) farther."""
        P = len(self.values)
        there = replace(self, values=self.values + step[:P], offset_s=self.offset_s + float(step[P]))
        return there.with_common(self.common + step[P + 1 :])

    def with_values(self, values: Array) -> CameraState:
        """The same with other values of the arm's parameters."""
        return replace(self, values=values)


def shape_of(common: Array) -> Array:
    """Shape of the target with the places of its markers behind it, (5 + Z,), of what images share (15 + Z,)."""
    return np.r_[common[LENS:READOUT], common[COMMON:]]

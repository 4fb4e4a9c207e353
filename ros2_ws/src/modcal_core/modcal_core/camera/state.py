"""Where a camera fit is: values of the arm's parameters, clock, lens, the sheet's shape, a rolling shutter's time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.camera.corners import READOUT
from modcal_core.camera.lens import COUNT as LENS
from modcal_core.camera.lens import Lens
from modcal_core.geometry.so3 import Array


@dataclass(frozen=True)
class CameraState:
    """values: of the arm's parameters, (P,). offset_s: of the clock. lens, shape (5,): as elsewhere. readout_s: in
    which a rolling shutter goes down an image.
    """

    values: Array
    offset_s: float
    lens: Lens
    shape: Array
    readout_s: float = 0.0

    @property
    def common(self) -> Array:
        """Lens, shape and readout, (15,)."""
        return np.r_[self.lens.values, self.shape, self.readout_s]

    def moved(self, step: Array) -> CameraState:
        """The state a step (P + 1 + 15,) farther."""
        P = len(self.values)
        common = step[P + 1 :]
        return CameraState(
            self.values + step[:P],
            self.offset_s + float(step[P]),
            self.lens.moved(common[:LENS]),
            self.shape + common[LENS:READOUT],
            self.readout_s + float(common[READOUT]),
        )

    def with_values(self, values: Array) -> CameraState:
        """The same with other values of the arm's parameters."""
        return replace(self, values=values)

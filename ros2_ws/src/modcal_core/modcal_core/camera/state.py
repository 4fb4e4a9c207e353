"""Where a camera fit is: values of the arm's parameters, clock, lens, the sheet's shape, a rolling shutter's time.

The sheet's size, its flatness and the lens's higher terms are fitted with these expectations and not left out, so that
what they may do to the arm is in its uncertainty: the sheet is suspected before the arm.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.camera.bundle import PlacePrior
from modcal_core.camera.corners import BOW, COMMON, READOUT, SCALE, SHAPE
from modcal_core.camera.lens import COUNT as LENS
from modcal_core.camera.lens import FISHEYE, Lens
from modcal_core.camera.target import PrintScale
from modcal_core.geometry import Array


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


# --- What is expected of lens and sheet before an image is looked at

FREE, TOLERANCE, FIXED = "free", "tolerance", "fixed"  # what becomes of stated intrinsics
_FOCAL, _CENTRE = 0.5, 0.1  # of the focal length and of the image's width: nothing is known of them
_RADIAL, _TANGENTIAL = (0.5, 0.5, 0.3), 0.01  # k1 k2 k3, p1 and p2 of lenses that are no fisheyes
_FISHEYE = 0.1  # k1 … k4 of fisheyes, of which most are within 0.05
_STATED_FOCAL, _STATED_CENTRE, _STATED_RADIAL, _STATED_TANGENTIAL = 0.005, 0.005, 0.02, 0.001  # of a usual calibration
BOW_M = 3e-4  # of a sheet glued to a board, at its corner; 0.5 mm is common
READOUT_S = 0.02  # of a rolling shutter: an image's rows fill most of the 16 to 33 ms between two; none of a global one
CLOCK_S = 0.05  # of stamps of a camera that nothing synchronises


@dataclass(frozen=True)
class CommonPrior:
    """Expectation of lens, shape, readout and places of markers. mean: (15 + Z,). information: inverse covariance,
    (15 + Z, 15 + Z), places as their tolerances have them. free: (15 + Z,) bool. places: None of a flat sheet.
    """

    mean: Array
    information: Array
    free: np.ndarray
    places: PlacePrior | None = None

    @property
    def shape(self) -> Array:
        """Prior mean of shape and marker places, (5 + Z,)."""
        return shape_of(self.mean)

    def with_places(self, places: PlacePrior) -> CommonPrior:
        """The same with markers whose places are expected so, of a body, which has no bow."""
        Z = len(places.apart)
        information = np.zeros((COMMON + Z, COMMON + Z))
        information[:COMMON, :COMMON] = self.information[:COMMON, :COMMON]
        information[COMMON:, COMMON:] = places.information(1.0)
        free = np.r_[self.free[:COMMON], np.ones(Z, bool)]
        free[BOW] = False
        return CommonPrior(np.r_[self.mean[:COMMON], np.zeros(Z)], information, free, places)


def common_prior(lens: Lens, scale: PrintScale, stated: str | None = None, flat: bool = False) -> CommonPrior:
    """The prior of this lens and print.

    stated: what becomes of the lens's values; None: they are a start, no statement. flat: whether the sheet is known to
    be flat (glass, aluminium).
    """
    width = float(lens.size[0])
    mean = np.r_[lens.values, scale.x - 1.0, scale.y - 1.0, np.zeros(COMMON - SCALE.stop)]
    std = np.empty(LENS)
    f = lens.values[:2].mean()
    if stated == TOLERANCE:
        std[:4] = [_STATED_FOCAL * f] * 2 + [_STATED_CENTRE * width] * 2
        std[4:] = [_STATED_RADIAL] * 2 + [_STATED_TANGENTIAL] * 2 + [_STATED_RADIAL]
        if lens.model == FISHEYE:
            std[4:] = _STATED_RADIAL
    else:
        std[:4] = [_FOCAL * f] * 2 + [_CENTRE * width] * 2
        std[4:] = [_RADIAL[0], _RADIAL[1], _TANGENTIAL, _TANGENTIAL, _RADIAL[2]]
        if lens.model == FISHEYE:
            std[4:] = _FISHEYE
        if stated != FIXED:
            mean[2:LENS] = [0.5 * (width - 1.0), 0.5 * (lens.size[1] - 1.0), 0.0, 0.0, 0.0, 0.0, 0.0]
    information = np.zeros((COMMON, COMMON))
    information[:LENS, :LENS] = np.diag(std**-2)
    information[SCALE, SCALE] = np.linalg.inv(scale.covariance)
    information[BOW, BOW] = np.eye(SHAPE - 2) / BOW_M**2
    information[READOUT, READOUT] = READOUT_S**-2
    free = np.ones(COMMON, bool)
    free[:LENS] = lens.used & (stated != FIXED)
    free[BOW] = not flat
    return CommonPrior(mean, information, free)

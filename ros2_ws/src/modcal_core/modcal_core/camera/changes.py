"""What changed among the images of a fit: a half that was moved, another focal length, or a focus that hunts.

A change moves the target in the images, or scales them, by a few numbers: the same from one image on, or another in
each image. Everything else integrated out, the images have a likelihood with these numbers drawn from what is usual,
and without them; the sizes of all errors are found again for both, for a change makes the images' own errors look
large. The likelihood has the price of the numbers in it: six of a half that was moved, one of a focal length.

A lens that bends as no parameter of the model does also makes images differ in size, and as much in shape. So a focus
that hunts is held against heights and widths that differ against each other from image to image.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.linalg

from modcal_core.camera.corners import POSE
from modcal_core.camera.equations import SolvedEquations
from modcal_core.camera.fit import CameraFit
from modcal_core.geometry import Array

_GAIN = 20.0  # of −2 log likelihood: odds of 1 : 20 000, for some hundred places in two halves
_SCREEN = 0.0  # the same at the sizes of the fit, which take some of a change for noise; below it there is none
_EDGE = 3  # images on either side
_USUAL = np.r_[[0.01] * 3, [0.02] * 3]  # m, rad; how far something is moved that is kicked
_USUAL_FOCAL = 0.02  # relative, of a focus or zoom that was touched
_SPREADS = np.geomspace(2e-4, 0.1, 28)  # relative, from what no image shows to another lens
_LEAST = 1e-3  # relative; lenses breathe by more than that when they focus again, and a fixed one by less as it warms


@dataclass(frozen=True)
class FoundChange:
    """From the image with index ``at`` on, the half in the world (in_world) or on the arm is elsewhere, or the camera
    has another focal length.

    gain: of −2 log likelihood. shift_m, turn_rad: by how much, 0 of a focal length. focal: relative change of the focal
    length, 0 where something was moved. each: whether it differs from image to image instead, by ``focal`` RMS.
    """

    gain: float
    in_world: bool
    at: int = 0
    shift_m: float = 0.0
    turn_rad: float = 0.0
    focal: float = 0.0
    each: bool = False

    def sentence(self, fit: CameraFit, whose: str = "") -> str:
        """The finding as a sentence. fit: that it was found in. whose: suffix that names the camera of several."""
        if self.each:
            return (
                f"The camera's focal length differs from image to image{whose}, by {100.0 * self.focal:.2g} % RMS: "
                "switch autofocus and digital zoom off, and take images again that are neither cropped nor scaled."
            )
        name, then = fit.table.names[self.at], "calibrate from the images before, or from those after"
        if self.focal:
            return (
                f"The camera{whose} has another focal length from image {name} on, by {100.0 * self.focal:+.1f} %: "
                f"switch autofocus off, leave focus and zoom alone, and {then}."
            )
        what = "target" if self.in_world == fit.poses.camera_on_tip else "camera"
        return (
            f"The {what}{whose} was moved before image {name}, by {1e3 * self.shift_m:.1f} mm and "
            f"{np.degrees(self.turn_rad):.2f}°: {then}."
        )


@dataclass(frozen=True)
class _Change:
    """columns: what its k numbers do to twist, lens and all else of an image, (N, 21 + Z, k). usual: standard
    deviations of the numbers, (k,). each: whether they differ from image to image, by a spread that the images decide.
    """

    columns: Array
    usual: Array = field(default_factory=lambda: np.array([_USUAL_FOCAL]))
    each: bool = False

    def best(self, solved: SolvedEquations, places: np.ndarray) -> tuple[float, int, Array]:
        """(gain of −2 log likelihood, first image after it, its values, or their spread) of the likeliest change.

        places: those of the first image after it that are tried, (M,).
        """
        by = solved.by_change(self.columns)
        own = by[:, :, :-1] @ self.columns
        arm = by[:, :, :POSE] @ solved.equations.cameras[0].moved
        cross = np.concatenate([arm, by[:, :, POSE:-1]], axis=2)[:, :, solved.use]
        factor = scipy.linalg.cho_factor(solved.H)
        score = by[:, :, -1] - cross @ scipy.linalg.cho_solve(factor, solved.b)
        if self.each:
            C = np.diag(own[:, 0, 0]) - cross[:, 0] @ scipy.linalg.cho_solve(factor, cross[:, 0].T)
            values, vectors = np.linalg.eigh(C)
            inside = 1.0 + np.outer(_SPREADS**2, np.maximum(values, 0.0))
            square = (vectors.T @ score[:, 0]) ** 2
            gains = (square * _SPREADS[:, None] ** 2 / inside - np.log(inside)).sum(axis=1)
            best = int(np.argmax(gains))
            return float(gains[best]), 0, _SPREADS[best : best + 1]
        own, cross, score = (np.cumsum(part[::-1], axis=0)[::-1][places] for part in (own, cross, score))
        back = scipy.linalg.cho_solve(factor, cross.reshape(-1, cross.shape[2]).T).reshape(-1, *cross.shape[:2])
        C = self.usual[:, None] * (own - cross @ back.transpose(1, 0, 2)) * self.usual + np.eye(len(self.usual))
        values = np.linalg.solve(C, (self.usual * score)[:, :, None])[:, :, 0]
        gains = (self.usual * score * values).sum(axis=1) - np.linalg.slogdet(C)[1]
        best = int(np.argmax(gains))
        return float(gains[best]), int(places[best]), self.usual * values[best]

    def weighed(self, fit: CameraFit, places: np.ndarray) -> tuple[float, Array]:
        """(−2 log likelihood with it, the sizes of all errors found again, and its values with these)."""

        def misfit(solved: SolvedEquations) -> float:
            return solved.misfit() - self.best(solved, places)[0]

        solved, least = fit.weighed(misfit_of=misfit)
        return least, self.best(solved, places)[2]


def find_change(fit: CameraFit) -> FoundChange | None:
    """The likeliest change among the images of a fit, None if none is beyond doubt."""
    T = fit.tool
    N = len(T)
    if N < 2 * _EDGE:
        return None
    width = fit.equations.cameras[0].grams.shape[1] - 1
    focal = fit.state.lens.values[:2]
    world, tip, wider, apart = (np.zeros((N, width, k)) for k in (POSE, POSE, 1, 1))
    world[:, :POSE], tip[:, :POSE] = fit.poses.half_motions(T)
    wider[:, POSE : POSE + 2, 0], apart[:, POSE : POSE + 2, 0] = focal, focal * [1.0, -1.0]
    changes = [_Change(world, _USUAL), _Change(tip, _USUAL), _Change(wider), _Change(wider, each=True)]
    solved, places = fit.equations.solve(fit.sizes), np.arange(_EDGE, N - _EDGE + 1)
    screened = [(k, one, *one.best(solved, places)[:2]) for k, one in enumerate(changes)]
    weighed = [(k, at, *one.weighed(fit, np.array([at]))) for k, one, gain, at in screened if gain >= _SCREEN]
    nothing = fit.weighed()[1] if weighed else 0.0
    for k, at, misfit, x in sorted(weighed, key=lambda found: found[2]):
        gain = nothing - misfit
        if gain < _GAIN:
            break
        if k < 2:
            shift = x[:3] + np.cross(x[3:], T[:, :3, 3].mean(0)) if k == 0 else x[:3]
            return FoundChange(gain, k == 0, at, float(np.linalg.norm(shift)), float(np.linalg.norm(x[3:])))
        each = changes[k].each
        if (each and x[0] < _LEAST) or (each and _Change(apart, each=True).weighed(fit, places)[0] - misfit < _GAIN):
            continue
        return FoundChange(gain, not fit.poses.camera_on_tip, at, focal=float(x[0]), each=each)
    return None

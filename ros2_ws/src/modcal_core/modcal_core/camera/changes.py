"""What changed among the images of a fit: a half that was moved, another focal length, or a focus that hunts.

A change moves the target in the images, or scales them, by a few numbers: the same from one image on, or another in
each image. Everything else integrated out, the images have a likelihood with these numbers drawn from what is usual,
and without them; the sizes of all errors are found again for both, for a change makes the images' own errors look
large. The likelihood has the price of the numbers in it: six of a half that was moved, one of a focal length.

A lens that bends as no parameter of the model does also makes images differ in size, and as much in shape. So a focus
that hunts is held against heights and widths that differ against each other from image to image.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from modcal_core.camera.corners import POSE
from modcal_core.camera.equations import ALONE, CameraRows, SolvedEquations, stops_of
from modcal_core.camera.fit import CameraFit
from modcal_core.geometry import Array

WORLD, TIP, _FOCAL, _EACH = (
    "world",
    "tip",
    "focal length",
    "focus",
)  # what changes: the half in the world, that on the arm, …
GAIN = 20.0  # of −2 log likelihood: odds of 1 : 20 000, for some hundred places in two halves
_SCREEN = 0.0  # the same at the sizes of the fit, which take some of a change for noise; below it there is none
_EDGE = 3  # images on either side
USUAL = np.r_[[0.01] * 3, [0.02] * 3]  # m, rad; how far something is moved that is kicked, or a joint that slips
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
class Change:
    """A change of images from one stop of the arm on. columns: by camera, what its k numbers do to twist, lens and all
    else of its images, (N, 21 + Z, k). usual: standard deviations of the numbers, (k,). each: whether they differ from
    stop to stop, by a spread that the images decide. order: the stops in order of time.
    """

    columns: Mapping[int, Array]
    usual: Array
    order: np.ndarray
    each: bool = False

    def best(self, solved: SolvedEquations, places: np.ndarray) -> tuple[float, int, Array]:
        """(gain of −2 log likelihood, first stop after it, its values, or their spread) of the likeliest change.

        places: those of the first stop after it that are tried, (M,), counted in order of time.
        """
        own, cross = (part[self.order] for part in solved.equations.by_change(solved.sizes, self.columns))
        score, cross = cross[:, :, -1], cross[:, :, solved.use]
        factor = scipy.linalg.cho_factor(solved.H)
        score = score - cross @ scipy.linalg.cho_solve(factor, solved.b)
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


def of_twist(rows: CameraRows, twists: Array) -> Array:
    """Columns (N, 21 + Z, k) of a change that moves the target by these twists (N, 6, k)."""
    out = np.zeros((len(twists), rows.grams.shape[1] - 1, twists.shape[2]))
    out[:, :POSE] = twists
    return out


def shift_of(half: str, values: Array, places: Array) -> float:
    """How far a half that was moved by these values (6,) is from where it was [m]. places: of the tool, (N, 3)."""
    shift = values[:3] + np.cross(values[3:], places.mean(axis=0)) if half == WORLD else values[:3]
    return float(np.linalg.norm(shift))


def find_change(fit: CameraFit) -> FoundChange | None:
    """The likeliest change among the images of a fit, None if none is beyond doubt."""
    # a camera that was moved would put the others' images of the same stops elsewhere as well
    cameras = tuple(replace(one, stop=np.full(len(one.stop), ALONE)) for one in fit.equations.cameras)
    fit = replace(fit, equations=replace(fit.equations, cameras=cameras))
    T, rows = fit.tool, cameras[0]
    N = len(T)
    if N < 2 * _EDGE:
        return None
    wider, apart = of_twist(rows, np.zeros((N, POSE, 1))), of_twist(rows, np.zeros((N, POSE, 1)))
    wider[:, POSE : POSE + 2, 0] = fit.state.lens.values[:2]
    apart[:, POSE : POSE + 2, 0] = fit.state.lens.values[:2] * [1.0, -1.0]
    order, focal = stops_of(cameras)[0], np.array([_USUAL_FOCAL])
    halves = dict(zip((WORLD, TIP), fit.poses.half_motions(T), strict=True))
    changes = {half: Change({0: of_twist(rows, moved)}, USUAL, order) for half, moved in halves.items()}
    changes |= {_FOCAL: Change({0: wider}, focal, order), _EACH: Change({0: wider}, focal, order, each=True)}
    solved, places = fit.equations.solve(fit.sizes), np.arange(_EDGE, N - _EDGE + 1)
    screened = [(what, one, *one.best(solved, places)[:2]) for what, one in changes.items()]
    weighed = [(what, at, *one.weighed(fit, np.array([at]))) for what, one, gain, at in screened if gain >= _SCREEN]
    nothing = fit.weighed()[1] if weighed else 0.0
    for what, at, misfit, x in sorted(weighed, key=lambda found: found[2]):
        gain = nothing - misfit
        if gain < GAIN:
            break
        if what in halves:
            shift, turn = shift_of(what, x, T[:, :3, 3]), float(np.linalg.norm(x[3:]))
            return FoundChange(gain, what == WORLD, at, shift, turn)
        shape = Change({0: apart}, focal, order, each=True)
        if what == _EACH and (x[0] < _LEAST or shape.weighed(fit, places)[0] - misfit < GAIN):
            continue
        return FoundChange(gain, not fit.poses.camera_on_tip, at, focal=float(x[0]), each=what == _EACH)
    return None

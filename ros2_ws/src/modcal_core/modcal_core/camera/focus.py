"""Whether the camera's focal length differs from image to image: autofocus, zoom, images scaled after they were taken.

Each image gets a relative change of the focal length of its own, drawn from a spread that the images decide. Integrated
out with everything else, that spread has a likelihood; the sizes of all other errors are found again with it, for a
focus that hunts makes the images' own errors look large.

A lens that bends as no parameter of the model does also makes images differ in size, by less, and as much in shape. So
it is held against what no focus does: heights and widths that differ against each other from image to image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from modcal_core.camera.changes import MovedHalf, moved_half
from modcal_core.camera.corners import POSE
from modcal_core.camera.equations import Sizes, SolvedEquations
from modcal_core.camera.fit import CameraFit
from modcal_core.camera.sizes import likeliest, usual
from modcal_core.geometry.so3 import Array

_GAIN = 20.0  # of −2 log likelihood, as of a move
_SCREEN = 6.0  # the same at the sizes of the fit, below which they are not found again
_SPREADS = np.geomspace(2e-4, 0.1, 28)  # relative, from what no image shows to another lens
_MIN = 1e-3  # relative; lenses breathe by more than that when they focus again, and a fixed one by less as it warms
_FOCUS, _SHAPE = np.array([1.0, 1.0]), np.array([1.0, -1.0])  # of focal lengths x and y


@dataclass(frozen=True)
class UnsteadyFocus:
    """spread: RMS by which the focal length differs from image to image, relative. gain: of −2 log likelihood."""

    spread: float
    gain: float

    @property
    def sentence(self) -> str:
        """The finding as a sentence."""
        return (
            f"The camera's focal length differs from image to image, by {100.0 * self.spread:.2g} % RMS: switch "
            "autofocus and digital zoom off, and take images again that are neither cropped nor scaled."
        )


def what_changed(fit: CameraFit, arm: float | None = None) -> tuple[MovedHalf | None, UnsteadyFocus | None]:
    """What was moved, or changed once, among the images of a fit, or the focus that differs from image to image: the
    likelier of the two. arm: as in the fit.
    """
    moved, focus = moved_half(fit, arm), unsteady_focus(fit, arm)
    if moved is None or focus is None:
        return moved, focus
    return (None, focus) if focus.gain > moved.gain and not moved.focal else (moved, None)


def unsteady_focus(fit: CameraFit, arm: float | None = None) -> UnsteadyFocus | None:
    """The spread of focal lengths among the images of a fit, None where none is beyond doubt. arm: as in the fit."""
    if _best(fit, fit.equations.solve(fit.sizes), _FOCUS)[0] < _SCREEN:
        return None
    without = likeliest(fit.equations, fit.sizes, arm)
    plain = fit.equations.solve(without).misfit() + usual(without)
    misfit, spread = _found_again(fit, without, arm, _FOCUS)
    if plain - misfit < _GAIN or spread < _MIN:
        return None
    rival, _ = _found_again(fit, without, arm, _SHAPE)
    return UnsteadyFocus(spread, plain - misfit) if rival - misfit >= _GAIN else None


def _found_again(fit: CameraFit, sizes: Sizes, arm: float | None, which: Array) -> tuple[float, float]:
    """(−2 log likelihood, spread) where focal lengths x and y differ by ``which``, with the sizes of all errors found
    again from these.
    """

    def misfit(solved: SolvedEquations) -> float:
        return solved.misfit() - _best(fit, solved, which)[0]

    along = likeliest(fit.equations, sizes, arm, misfit)
    solved = fit.equations.solve(along)
    return misfit(solved) + usual(along), _best(fit, solved, which)[1]


def _best(fit: CameraFit, solved: SolvedEquations, which: Array) -> tuple[float, float]:
    """(gain of −2 log likelihood, spread) of the likeliest spread of focal lengths, at these sizes."""
    C, b = _by_focal(fit, solved, which)
    values, vectors = np.linalg.eigh(C)
    square = (vectors.T @ b) ** 2
    inside = 1.0 + np.outer(_SPREADS**2, np.maximum(values, 0.0))
    gains = (square * _SPREADS[:, None] ** 2 / inside - np.log(inside)).sum(axis=1)
    best = int(np.argmax(gains))
    return float(gains[best]), float(_SPREADS[best])


def _by_focal(fit: CameraFit, solved: SolvedEquations, which: Array) -> tuple[Array, Array]:
    """(information (N, N), score (N,)) of a relative change of the focal lengths of each image, x and y by ``which``,
    all else integrated out.
    """
    lens = slice(POSE, POSE + 2)
    G, focal = solved.grams / solved.noise**2, which * fit.state.lens.values[:2]
    row = np.einsum("f,nfk->nk", focal, G[:, lens])
    weighed = row - np.einsum("np,npq,nqk->nk", row[:, :POSE], solved.S, G[:, :POSE], optimize=True)
    own = weighed[:, lens] @ focal
    arm = np.einsum("np,npk->nk", weighed[:, :POSE], fit.equations.moved)
    cross = np.concatenate([arm, weighed[:, POSE:-1]], axis=1)[:, solved.use]
    factor = scipy.linalg.cho_factor(solved.H)
    C = np.diag(own) - cross @ scipy.linalg.cho_solve(factor, cross.T)
    return C, weighed[:, -1] - cross @ scipy.linalg.cho_solve(factor, solved.b)

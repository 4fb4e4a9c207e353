"""Whether camera or target was moved between two of the images, the half in the world or the one on the arm, or the
camera's focus or zoom was changed.

For each place in their order, six more parameters move one half from there on; a scan of small sums finds the place
that gains most. Then the sizes of all errors are found again with the move and without: a move makes the images' own
errors look large, so that only both together say whether it is there. What counts is the likelihood with everything
integrated out, which has the price of six more parameters in it.

Another focal length looks much like a camera that was moved along its axis, with one number in place of six: where it
explains more than the move does, that is what happened.

Each image gets a relative change of the focal length of its own, drawn from a spread that the images decide. Integrated
out with everything else, that spread has a likelihood; the sizes of all other errors are found again with it, for a
focus that hunts makes the images' own errors look large.

A lens that bends as no parameter of the model does also makes images differ in size, by less, and as much in shape. So
it is held against what no focus does: heights and widths that differ against each other from image to image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from modcal_core.camera.corners import POSE
from modcal_core.camera.equations import Equations, Sizes, SolvedEquations
from modcal_core.camera.fit import CameraFit, likeliest, usual
from modcal_core.geometry import Array, so3

_GAIN = 20.0  # of −2 log likelihood: odds of 1 : 20 000, for some hundred places in two halves
_USUAL_M, _USUAL_RAD = 0.01, 0.02  # how far something is moved that is kicked
_SCREEN = 6.0  # gain at the sizes of the fit, below which nothing is worth a second look
_EDGE = 3  # images on either side


@dataclass(frozen=True)
class MovedHalf:
    """From the image with index ``at`` on, the half in the world (in_world) or on the arm is elsewhere, or the camera
    has another focal length.

    shift_m, turn_rad: by how much. gain: of −2 log likelihood. focal: relative change of the focal length, 0 where
    something was moved; then shift_m and turn_rad are 0.
    """

    at: int
    in_world: bool
    shift_m: float
    turn_rad: float
    gain: float
    focal: float = 0.0


def moved_half(fit: CameraFit, arm: float | None = None) -> MovedHalf | None:
    """The likeliest move among the images of a fit, None where none is beyond doubt. arm: as in the fit."""
    T, _ = fit.poses.tool_motions(fit.state.values, fit.state.offset_s)
    N = len(T)
    if N < 2 * _EDGE:
        return None
    R, p = T[:, :3, :3], T[:, :3, 3]
    eye, zero = np.broadcast_to(np.eye(3), (N, 3, 3)), np.zeros((N, 3, 3))
    by_world = np.concatenate([np.concatenate([eye, -so3.hat(p)], 2), np.concatenate([zero, eye], 2)], 1)
    by_tool = np.concatenate([np.concatenate([R, zero], 2), np.concatenate([zero, R], 2)], 1)
    scanned = []
    for in_world, motions in ((True, by_world), (False, by_tool)):
        twists = fit.poses.as_twists(T, motions)
        at, gain, _ = _scan(fit.equations, fit.sizes, _beside_nothing(fit.equations, twists))
        scanned.append((gain, at, in_world, twists))
    gain, at, in_world, twists = max(scanned, key=lambda s: s[0])
    if gain < _SCREEN:
        return None
    added = np.where((np.arange(N) >= at)[:, None, None], twists, 0.0)
    wider = _with_move(fit.equations, added)
    without, along = likeliest(fit.equations, fit.sizes, arm), likeliest(wider, fit.sizes, arm)
    solved = wider.solve(along)
    better = fit.equations.solve(without).misfit() - solved.misfit()
    if better < _GAIN:
        return None
    zoom = _beside_nothing(fit.equations, np.zeros((N, POSE, 1)))
    zoom[:, POSE : POSE + 2, 0] = fit.state.lens.values[:2]
    begin, as_zoom, focal = _scan(fit.equations, along, zoom)
    if as_zoom > _scan(fit.equations, along, _beside_nothing(fit.equations, twists))[1]:
        camera_in_world = not fit.poses.camera_on_tip
        return MovedHalf(begin, camera_in_world, 0.0, 0.0, better, float(focal[0]))
    K = fit.equations.moved.shape[2]
    step = solved.step()[K : K + 6]
    shift = step[:3] + np.cross(step[3:], p.mean(0)) if in_world else step[:3]
    return MovedHalf(at, in_world, float(np.linalg.norm(shift)), float(np.linalg.norm(step[3:])), better)


def _with_move(eq: Equations, added: Array) -> Equations:
    """The equations with six more parameters, these twists (N, 6, 6), behind those of arm and clock."""
    K, six = eq.moved.shape[2], np.arange(6)
    others = eq.beside
    if others is not None:
        others = replace(others, J=np.concatenate([others.J, np.zeros((len(others.J), 6))], axis=1))
    information = np.insert(np.insert(eq.information, [K] * 6, 0.0, axis=0), [K] * 6, 0.0, axis=1)
    information[K + six, K + six] = np.repeat([_USUAL_M**-2, _USUAL_RAD**-2], 3)
    return replace(
        eq,
        moved=np.concatenate([eq.moved, added], axis=2),
        arm=np.r_[eq.arm, np.zeros(6, bool)],
        offset=np.insert(eq.offset, [K] * 6, 0.0),
        information=information,
        free=np.insert(eq.free, [K] * 6, True),
        beside=others,
        others=tuple(replace(o, columns=np.where(o.columns >= K, o.columns + 6, o.columns)) for o in eq.others),
    )


def _beside_nothing(eq: Equations, twists: Array) -> Array:
    """Columns (N, 6 + 15 + Z, k) of what moves the target by twists (N, 6, k) and leaves all that images share."""
    shared = eq.grams.shape[1] - 1 - POSE
    return np.concatenate([twists, np.zeros((len(twists), shared, twists.shape[2]))], axis=1)


def _scan(eq: Equations, sizes: Sizes, columns: Array) -> tuple[int, float, Array]:
    """(first image after the change, gain, its k values) of the best place, for what the change does to the target's
    twist and to what all images share, (N, 6 + 15 + Z, k).
    """
    solved = eq.solve(sizes)
    E = solved.E
    k = columns.shape[2]
    weighed = np.swapaxes(columns, 1, 2) @ E[:, :-1]
    own = weighed[:, :, :-1] @ columns
    arm = weighed[:, :, :POSE] @ eq.moved
    right = weighed[:, :, -1]
    cross = np.concatenate([arm, weighed[:, :, POSE:-1]], axis=2)[:, :, solved.use]
    factor = scipy.linalg.cho_factor(solved.H)
    step = scipy.linalg.cho_solve(factor, solved.b)
    best = (0, -np.inf, np.zeros(k))
    for at in range(_EDGE, len(columns) - _EDGE + 1):
        B = cross[at:].sum(0)
        C = own[at:].sum(0) - B @ scipy.linalg.cho_solve(factor, B.T)
        C = C + 1e-9 * np.eye(k)
        b = right[at:].sum(0) - B @ step
        x = np.linalg.solve(C, b)
        gain = float(b @ x)
        if gain > best[1]:
            best = at, gain, x
    return best


# --- Whether the camera's focal length differs from image to image

_FOCUS_GAIN = 20.0  # of −2 log likelihood, as of a move
_FOCUS_SCREEN = 6.0  # the same at the sizes of the fit, below which they are not found again
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
    if _best(fit, fit.equations.solve(fit.sizes), _FOCUS)[0] < _FOCUS_SCREEN:
        return None
    without = likeliest(fit.equations, fit.sizes, arm)
    plain = fit.equations.solve(without).misfit() + usual(without)
    misfit, spread = _found_again(fit, without, arm, _FOCUS)
    if plain - misfit < _FOCUS_GAIN or spread < _MIN:
        return None
    rival, _ = _found_again(fit, without, arm, _SHAPE)
    return UnsteadyFocus(spread, plain - misfit) if rival - misfit >= _FOCUS_GAIN else None


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

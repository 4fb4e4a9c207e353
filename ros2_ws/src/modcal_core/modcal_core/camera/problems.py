"""What contradicts a camera fit, what has a length that somebody measured, and what the sheet's size leaves open.

The calibrated and the nominal arm are compared draw by draw, not interval by interval: what is open of lens, sheet and
the camera's place moves both alike, so that one may be the better beyond doubt where their intervals overlap. What the
user states of the nominal arm is no draw, and there the interval has to be below it.

Something may have been moved among the images. For each place in their order, six more parameters move one half from
there on; a scan of small sums finds the place that gains most. Then the sizes of all errors are found again with the
move and without: a move makes the images' own errors look large, so that only both together say whether it is there.
What counts is the likelihood with everything integrated out, which has the price of six more parameters in it.

Another focal length looks much like a camera that was moved along its axis, with one number in place of six: where it
explains more than the move does, that is what happened.

Each image gets a relative change of the focal length of its own, drawn from a spread that the images decide. Integrated
out with everything else, that spread has a likelihood; the sizes of all other errors are found again with it, for a
focus that hunts makes the images' own errors look large.

A lens that bends as no parameter of the model does also makes images differ in size, by less, and as much in shape. So
it is held against what no focus does: heights and widths that differ against each other from image to image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from modcal_core.camera.bundle import CalibrationTarget, PrintedTarget
from modcal_core.camera.contradicted import SIZE, DoubtedStatement
from modcal_core.camera.corners import POSE
from modcal_core.camera.equations import Equations, Sizes, SolvedEquations
from modcal_core.camera.fit import CameraFit, likeliest, usual
from modcal_core.camera.lens import COUNT as LENS
from modcal_core.camera.other_readings import ReadingsBeside
from modcal_core.camera.tool_error import ToolError
from modcal_core.geometry import Array

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
    scanned = []
    for in_world, twists in zip((True, False), fit.poses.half_motions(T), strict=True):
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
    shift = step[:3] + np.cross(step[3:], T[:, :3, 3].mean(0)) if in_world else step[:3]
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


APPLY, DO_NOT_APPLY, CANNOT_TELL = "apply", "do not apply", "cannot tell"
# Chance of an arm made worse that may be taken. Few calibrations come near it: with 1 %, the chances of a hundred of
# them add up to 0.05 arms that are made worse (38 simulated cells), with 2 % to 0.1, with 5 % to 0.4.
_WORSE = 0.01
_WHAT_TELLS = (
    "measure the two rulers on the sheet (modcal target --measured), state the arm's accuracy (--arm-mm), "
    "or add a second target at another distance, two scale marks, a ball in a socket or a few tracker points"
)

_BODY_TELLS = (
    "state how well the body's size is known (size_tolerance in the target file: a calliper across it tells), state "
    "the arm's accuracy (--arm-mm), or add a few tracker points"
)


@dataclass(frozen=True)
class Decision:
    """word: one of apply, do not apply, cannot tell. because: sentences. chance_worse: of an arm worse than drawn.
    problems: those sentences that say what contradicts the fit.
    """

    word: str
    because: tuple[str, ...]
    chance_worse: float
    problems: tuple[str, ...] = ()


def decide(
    error: ToolError,
    metric: bool,
    problems: tuple[str, ...],
    stated_m: float | None = None,
    doubtful: tuple[str, ...] = (),
    size: str = "",
    body: bool = False,
) -> Decision:
    """The decision over the postures that were asked for.

    metric: whether anything states a length beyond the arm's own drawing. problems: what contradicts the fit. stated_m:
    RMS error of the nominal arm, as the user states it [m]. doubtful: statements in doubt, in sentences. size: what to
    do about the sheet's size, where it is what keeps the arm from being clearly better; nothing where it is not. body:
    whether the target is a body with markers, and the error that of the arm by itself.
    """
    worse = error.chance_worse
    middle, _, high = error.interval
    drawn, drawn_low, _ = error.nominal_interval
    if problems:
        return Decision(DO_NOT_APPLY, problems, worse, problems)
    if not metric:
        said = "Nothing in these images has a length that somebody measured: "
        return Decision(CANNOT_TELL, (said + (_BODY_TELLS if body else _WHAT_TELLS) + ".",), worse)
    whose = "By itself, wherever camera and body stand, the" if body else "The"
    compared = (
        f"{whose} calibrated arm is off by {1e3 * middle:.2f} mm RMS at the tool (95 %: up to {1e3 * high:.2f} mm), "
        f"the nominal arm by {1e3 * drawn:.2f} mm (95 %: at least {1e3 * drawn_low:.2f} mm)"
    )
    if worse > _WORSE or (stated_m is not None and high >= stated_m):
        if size:
            return Decision(CANNOT_TELL, (f"{compared}. {size}", *doubtful), worse)
        stated = "" if stated_m is None else f", and {1e3 * stated_m:.2f} mm is stated of it"
        return Decision(DO_NOT_APPLY, (f"{compared}{stated}: that is not clearly better.", *doubtful), worse)
    alike = ""
    if high >= drawn:
        alike = (
            " What is open of lens, sheet and places moves both alike; the chance that the calibrated arm is no better "
            f"is {max(100.0 * worse, 0.1):.1f} %."
        )
    return Decision(APPLY, (f"{compared}.{alike}", *doubtful), worse)


MANY_OUT = 0.05  # share of images left out beyond which a verdict is open (verdict.md)
_CORNERS_OUT = 0.05  # share of corners left out beyond which the target is another
_UNSTEADY = 2e-3  # rad (or m) a joint that an image differs from the fit: ten times what gears and springs do
_MOSTLY = 0.5  # of the mean square error at the tool
_SCALE_SIGMAS = 4.0  # by how many standard deviations the sheet's size may differ from what is stated of it


def problems(
    fit: CameraFit,
    nominal: CameraFit,
    moved: MovedHalf | None,
    wrong: tuple[str, ...],
    left_out: dict[str, str],
    count: int,
    corners_out: float,
    target: CalibrationTarget,
    focus: UnsteadyFocus | None = None,
) -> tuple[str, ...]:
    """What contradicts the fit, in sentences."""
    out = []
    if not (fit.converged and nominal.converged):
        out.append("The fit did not reach its minimum.")
    if moved is not None:
        out.append(moved_sentence(fit, moved))
    if focus is not None:
        out.append(focus.sentence)
    out += wrong
    if fit.sizes.joint > _UNSTEADY:
        out.append(
            f"Images are {1e3 * fit.sizes.joint:.1f} mrad a joint off any arm of this form, each by itself: check that "
            "the arm stood still, that joints and images are of the same moment, and that nothing is loose."
        )
    if len(left_out) > MANY_OUT * count:
        out.append(f"{len(left_out)} of {count} images were left out.")
    if corners_out > _CORNERS_OUT and not fit.table.places:  # of bodies: misread
        out.append(f"{100.0 * corners_out:.0f} % of all corners fit no flat target of the stated form.")
    P = fit.poses.count
    # the places of a body's markers say what is wrong of its size as well
    for i, axis in enumerate("" if wrong or fit.table.places else "xy"):
        off = fit.state.shape[i] - (getattr(target.scale, axis) - 1.0)
        usual = np.hypot(target.scale.std, 0.5 * target.scale.std_apart)
        if abs(off) > _SCALE_SIGMAS * usual:
            std = float(np.sqrt(fit.covariance[P + 1 + LENS + i, P + 1 + LENS + i]))
            out.append(
                f"The sheet is {100.0 * off:+.1f} ± {100.0 * std:.1f} % off its stated size along {axis}: measure a "
                "square, and check the target file."
            )
    return tuple(out)


def moved_sentence(fit: CameraFit, moved: MovedHalf, whose: str = "") -> str:
    """Sentence that target or camera was moved among the images of a fit, or that the focus changed. whose: suffix that
    names the camera, where there are several.
    """
    name = fit.table.names[moved.at]
    if moved.focal:
        return (
            f"The camera{whose} has another focal length from image {name} on, by {100.0 * moved.focal:+.1f} %: switch "
            "autofocus off, leave focus and zoom alone, and calibrate from the images before, or from those after."
        )
    what = "target" if moved.in_world == fit.poses.camera_on_tip else "camera"
    return (
        f"The {what}{whose} was moved before image {name}, by {1e3 * moved.shift_m:.1f} mm and "
        f"{np.degrees(moved.turn_rad):.2f}°: calibrate from the images before, or from those after."
    )


def metric_of(target: CalibrationTarget, arm_m: float | None, beside: ReadingsBeside | None) -> tuple[str, ...]:
    """What has a length that somebody measured or states."""
    known = "the sheet's rulers were measured" if isinstance(target, PrintedTarget) else "the body's size is stated"
    out = [known] if target.scale.measured else []
    if beside is not None and beside.metric:
        out.append(f"readings of {beside.label}")
    return (*out, "the arm's accuracy is stated") if arm_m is not None else tuple(out)


def size_open(
    target: CalibrationTarget,
    doubted: Sequence[DoubtedStatement],
    error: ToolError,
    shared: dict[str, tuple[float, float]],
    arm_m: float | None,
) -> str:
    """What to do about the sheet's size where it is what keeps the arm from being clearly better, else nothing."""
    if target.scale.measured:
        what = "sheet" if isinstance(target, PrintedTarget) else "body"
        likeliest_doubt = max(doubted, key=lambda d: d.counted).what == SIZE
        if likeliest_doubt and decide(error.as_stated, True, (), arm_m).word == APPLY:
            again = f"measure the {what} again"
            if target.scale.unsaid:
                again = "read both rulers again, and state how well (--measured-to-mm)"
            if target.scale.nominal:
                again = (
                    "both rulers are stated at their nominal lengths, as by somebody who has not measured them: "
                    "measure them, and state how well (--measured-to-mm)"
                )
            return (
                f"If the {what} has the size that is stated, it is clearly better; these images leave that open: "
                f"{again}, or add a length of another kind, such as a few tracker points."
            )
        return ""
    whole, known = shared.get("print scale", (0.0, 0.0))
    if known >= _MOSTLY * whole:
        return ""
    said = "sheet's size, which nobody has measured: measure its rulers (modcal target --measured)"
    if not isinstance(target, PrintedTarget):
        said = "body's size, which nobody has stated: measure across it with a calliper and state size_tolerance"
    return f"Most of that is the {said}; with it, {1e3 * known**0.5:.2f} mm are left."

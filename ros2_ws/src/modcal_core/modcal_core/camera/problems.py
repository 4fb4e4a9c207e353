"""What contradicts a camera fit, what has a length that somebody measured, and what the sheet's size leaves open.

The calibrated and the nominal arm are compared draw by draw, not interval by interval: what is open of lens, sheet and
the camera's place moves both alike, so that one may be the better beyond doubt where their intervals overlap. What the
user states of the nominal arm is no draw, and there the interval has to be below it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.camera.changes import MovedHalf, UnsteadyFocus
from modcal_core.camera.contradicted import SIZE, DoubtedStatement
from modcal_core.camera.fit import CameraFit
from modcal_core.camera.lens import COUNT as LENS
from modcal_core.camera.other_readings import ReadingsBeside
from modcal_core.camera.target import CalibrationTarget, PrintedTarget
from modcal_core.camera.tool_error import ToolError

# --- Whether to use the calibrated arm: *apply*, *do not apply*, or *cannot tell*, and why, in words

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
    if known < _MOSTLY * whole and not isinstance(target, PrintedTarget):
        return (
            f"Most of that is the body's size, which nobody has stated: measure across it with a calliper and state "
            f"size_tolerance; with it, {1e3 * known**0.5:.2f} mm are left."
        )
    if known < _MOSTLY * whole:
        return (
            f"Most of that is the sheet's size, which nobody has measured: measure its rulers (modcal target "
            f"--measured); with it, {1e3 * known**0.5:.2f} mm are left."
        )
    return ""

"""What contradicts a camera fit, what has a length that somebody measured, and what the sheet's size leaves open."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.camera.beside import ReadingsBeside
from modcal_core.camera.changes import MovedHalf
from modcal_core.camera.contradicted import SIZE, DoubtedStatement
from modcal_core.camera.decision import APPLY, decide
from modcal_core.camera.fit import CameraFit
from modcal_core.camera.focus import UnsteadyFocus
from modcal_core.camera.lens import COUNT as LENS
from modcal_core.camera.target import CalibrationTarget, PrintedTarget
from modcal_core.camera.tool_error import ToolError

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

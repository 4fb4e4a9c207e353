"""What speaks against a camera fit, and whether to apply it: apply, do not apply, cannot tell, each with its reasons.

The calibrated and the nominal arm are compared draw by draw, not interval by interval: what is open of lens, sheet and
the camera's place moves both alike, so that one may be the better beyond doubt where their intervals overlap. What the
user states of the nominal arm is no draw, and there the interval has to be below it.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from modcal_core.camera.bundle import CalibrationTarget, PrintedTarget, PrintScale
from modcal_core.camera.changes import FoundChange
from modcal_core.camera.claim import ToolError
from modcal_core.camera.corners import BOW as BENT
from modcal_core.camera.corners import SCALE
from modcal_core.camera.fit import CameraFit
from modcal_core.camera.lens import COUNT as LENS
from modcal_core.camera.other_readings import ReadingsBeside
from modcal_core.camera.statements import (
    BOW,
    IN_DOUBT,
    LENS_VALUES,
    SIZE,
    DoubtedStatement,
    StatedCamera,
    arm_contradicted,
    contradicted,
)
from modcal_core.geometry import Array

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


@dataclass(frozen=True)
class DecisionGrounds:
    """What a decision is made from beside the errors at the tool.

    metric: whether anything states a length beyond the arm's own drawing. problems: what contradicts the fit. stated_m:
    RMS error of the nominal arm, as the user states it [m]. doubtful: statements in doubt, in sentences. size: what to
    do about the sheet's size, where it is what keeps the arm from being clearly better; nothing where it is not. body:
    whether the target is a body with markers, and the error that of the arm by itself.
    """

    metric: bool = True
    problems: tuple[str, ...] = ()
    stated_m: float | None = None
    doubtful: tuple[str, ...] = ()
    size: str = ""
    body: bool = False


def decide(error: ToolError, on: DecisionGrounds) -> Decision:
    """The decision over the postures that were asked for."""
    worse = error.chance_worse
    middle, _, high = error.interval
    drawn, drawn_low, _ = error.nominal_interval
    if on.problems:
        return Decision(DO_NOT_APPLY, on.problems, worse, on.problems)
    if not on.metric:
        said = "Nothing in these images has a length that somebody measured: "
        return Decision(CANNOT_TELL, (said + (_BODY_TELLS if on.body else _WHAT_TELLS) + ".",), worse)
    whose = "By itself, wherever camera and body stand, the" if on.body else "The"
    compared = (
        f"{whose} calibrated arm is off by {1e3 * middle:.2f} mm RMS at the tool (95 %: up to {1e3 * high:.2f} mm), "
        f"the nominal arm by {1e3 * drawn:.2f} mm (95 %: at least {1e3 * drawn_low:.2f} mm)"
    )
    if worse > _WORSE or (on.stated_m is not None and high >= on.stated_m):
        if on.size:
            return Decision(CANNOT_TELL, (f"{compared}. {on.size}", *on.doubtful), worse)
        stated = "" if on.stated_m is None else f", and {1e3 * on.stated_m:.2f} mm is stated of it"
        return Decision(DO_NOT_APPLY, (f"{compared}{stated}: that is not clearly better.", *on.doubtful), worse)
    alike = ""
    if high >= drawn:
        alike = (
            " What is open of lens, sheet and places moves both alike; the chance that the calibrated arm is no better "
            f"is {max(100.0 * worse, 0.1):.1f} %."
        )
    return Decision(APPLY, (f"{compared}.{alike}", *on.doubtful), worse)


_MANY_OUT = 0.05  # share of images left out beyond which a verdict is open (verdict.md)
_CORNERS_OUT = 0.05  # share of corners left out beyond which the target is another
_UNSTEADY = 2e-3  # rad (or m) a joint that an image differs from the fit: ten times what gears and springs do
_MOSTLY = 0.5  # of the mean square error at the tool


def problems(
    fit: CameraFit,
    nominal: CameraFit,
    change: FoundChange | None,
    wrong: tuple[str, ...],
) -> tuple[str, ...]:
    """What contradicts the fit, in sentences. wrong: statements that images contradict."""
    out = [] if fit.converged and nominal.converged else ["The fit did not reach its minimum."]
    if change is not None:
        out.append(change.sentence(fit))
    out += wrong
    if fit.sizes.joint > _UNSTEADY:
        out.append(
            f"Images are {1e3 * fit.sizes.joint:.1f} mrad a joint off any arm of this form, each by itself: check that "
            "the arm stood still, that joints and images are of the same moment, and that nothing is loose."
        )
    if fit.table.places:  # of a body points are misread, and the places of its markers say what is wrong of its size
        return tuple(out)
    if fit.table.left_out > _CORNERS_OUT:
        out.append(f"{100.0 * fit.table.left_out:.0f} % of all corners fit no flat target of the stated form.")
    return tuple(out)


def left_out_images(left_out: Collection[str], count: int, whose: str = "") -> tuple[str, ...]:
    """Sentence that more images than a verdict passes over were left out of so many; nothing where that is not so."""
    if len(left_out) <= _MANY_OUT * count:
        return ()
    return (f"{len(left_out)} of {count} images{whose} were left out.",)


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
        if likeliest_doubt and decide(error.as_stated, DecisionGrounds(stated_m=arm_m)).word == APPLY:
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


_PLAIN = {"fx": "focal length", "fy": "focal length", "cx": "centre", "cy": "centre"}


def contradictions(fit: CameraFit, doubted: Sequence[DoubtedStatement], stated: StatedCamera) -> tuple[str, ...]:
    """What the images contradict of what was stated. doubted: of this fit."""
    out = [_contradiction(what, other, stated) for what, other in contradicted(fit, doubted).items()]
    if (times := arm_contradicted(fit)) is not None:
        out.append(
            f"The arm is some {times:.1f} times as far off as --arm-mm states: state what you know of it, or check the "
            "square's size."
        )
    return tuple(out)


def in_doubt(fit: CameraFit, doubted: Sequence[DoubtedStatement], scale: PrintScale) -> tuple[str, ...]:
    """What the images leave in doubt of what was stated, in sentences."""
    out = []
    for doubt in doubted:
        if doubt.chance > IN_DOUBT:
            common = fit.state.common + doubt.solved.step()[fit.poses.count + 1 :]
            what = {
                SIZE: f"a {_sized(fit)} {_percent(fit, common, scale)} off its stated size",
                BOW: f"a sheet bent by {1e3 * float(np.abs(common[BENT]).max()):.1f} mm",
                LENS_VALUES: "another lens than the stated one",
            }[doubt.what]
            out.append(
                f"An arm with these faults and {what} look much alike (chance of the latter "
                f"{100.0 * doubt.chance:.0f} %): check that statement, or add a length of another kind, such "
                "as a few tracker points."
            )
    return tuple(out)


def _contradiction(what: str, other: CameraFit, stated: StatedCamera) -> str:
    """The sentence for a wrong statement. other: the fit with its tolerance widened."""
    std = np.sqrt(np.diag(other.covariance))[other.poses.count + 1 :]
    if what == SIZE:
        return (
            f"The {_sized(other)} is {_percent(other, other.state.common, stated.scale)} off its stated size, ± "
            f"{100.0 * float(std[LENS]):.1f} %, or the arm is built to another scale than its URDF: measure "
            f"{'across it' if other.table.places else 'a square'}, and check the target file."
        )
    if what == BOW:
        worst = float(np.abs(other.table.bow @ other.state.shape[2:]).max())
        return f"The sheet is bent by {1e3 * worst:.1f} mm towards its edge: glue it to something flat."
    found, values, names = other.state.lens.values, stated.lens.values, stated.lens.names
    i = int(np.argmax(np.abs(found - values) / np.maximum(std[:LENS], 1e-9)))
    return (
        f"The images contradict the stated lens: {_PLAIN.get(names[i], names[i])} {found[i]:.4g} ± {std[i]:.2g} "
        f"and not {values[i]:.4g}. Give the camera_info of this camera, focus and resolution, or leave it away."
    )


def _sized(fit: CameraFit) -> str:
    """What has a size."""
    return "body" if fit.table.places else "sheet"


def _percent(fit: CameraFit, common: Array, scale: PrintScale) -> str:
    """By how much a sheet is off along x and y, or a body as a whole."""
    x, y = common[SCALE] + 1.0
    along_x = f"{100.0 * (x / scale.x - 1.0):+.1f} %"
    return along_x if fit.table.places else f"{along_x} (x) and {100.0 * (y / scale.y - 1.0):+.1f} % (y)"

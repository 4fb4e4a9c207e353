"""Whether to use the calibrated arm: *apply*, *do not apply*, or *cannot tell*, and why, in words.

The calibrated and the nominal arm are compared draw by draw, not interval by interval: what is open of lens, sheet and
the camera's place moves both alike, so that one may be the better beyond doubt where their intervals overlap. What the
user states of the nominal arm is no draw, and there the interval has to be below it.
"""

from __future__ import annotations

from dataclasses import dataclass

from modcal_core.camera.tool_error import ToolError

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

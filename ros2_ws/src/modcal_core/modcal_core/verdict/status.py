"""The status: open, at the floor, or cannot tell, with its reasons, in the order of ``docs/verdict.md``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from modcal_core.calibration import FINEST, Stated
from modcal_core.measurements import MIN_RETURNS
from modcal_core.verdict.account import account
from modcal_core.verdict.along_motion import along_motion
from modcal_core.verdict.case import Case
from modcal_core.verdict.contributions import Contribution, contributions, mean_square, resampled
from modcal_core.verdict.estimation import estimation
from modcal_core.verdict.floor import Floor, Floors, floors
from modcal_core.verdict.grounds import Grounds
from modcal_core.verdict.one_joint import LARGELY, one_joint
from modcal_core.verdict.one_place import one_place
from modcal_core.verdict.one_topic import one_topic
from modcal_core.verdict.outside import worse_outside
from modcal_core.verdict.predictable import Predictable, predictable
from modcal_core.verdict.two_groups import two_groups
from modcal_core.verdict.uneven import uneven
from modcal_core.verdict.verdict import Reason, ReasonKind, Repeatability, Row, Status, Verdict

MAX_REJECTED = 0.05  # share of the stations: one of twenty may be a wrong reading
MAX_NOT_APPLIED = 0.10  # of E², that an effect which cannot be applied may cost: 5 % in RMS
MAX_PREDICTABLE = 0.05  # lower end (99 %) of the share of E² that is predictable: 2.5 % in RMS (sweep)
MAX_OF_REACH = 5e-4  # that returns may differ by; industrial arms repeat to some 1e-4 of their reach (ISO 9283 RP)
MAX_TURNED = 1.0  # deg; the same of orientations, which coarse instruments know to some tenths
MAX_OVERSTATED = 4.0  # times what is left, in RMS; data sheets give what is never exceeded, some three times the usual
MAX_ABOVE_FLOOR = 1.44  # E² in units of F²: a fifth more in RMS, about what six returns know a floor to (sweep)


def judge(
    case: Case,
    grounds: Grounds | None = None,
    stated: Stated | None = None,
    parts: tuple[Contribution, ...] | None = None,
) -> Verdict:
    """The verdict on a case.

    grounds: what other stages found. stated: repeatability and instrument, where a person states them. parts: what each
    effect contributes, where that is known already.
    """
    grounds = grounds or Grounds()
    if not len(case.held_out):
        return Verdict("cannot_tell", remedy="Record more stations: none was left for the score.")
    parts = contributions(case) if parts is None else parts
    known = floors(case.residuals, case.samples, case.wrong, stated)
    own = estimation(case)
    seen = predictable(case)
    angles = bool(case.samples.is_pose[case.held_out].any())
    reasons = (
        *_reasons("not_converged", _not_reached(grounds)),
        *_reasons("rejected", _rejected(case, grounds)),
        *_reasons("not_applied", _not_applied(case, grounds)),
        *_reasons("contradiction", (*grounds.contradictions, *known.contradictions)),
        *(loose := tuple(_reasons("contradiction", _loose(case, known, stated)))),
        *_reasons("contradiction", _two_groups(case)),
        *_reasons("contradiction", _below_stated(case, known.position, angle=False)),
        *_reasons("contradiction", _below_stated(case, known.rotation, angle=True) if angles else ()),
        *_reasons("predictable", _predictable(seen)),
        *_reasons("predictable", _one_topic(case)),
        *_reasons("predictable", _along_motion(case, stated)),
        *_reasons("above_floor", _above_floor(case, known.position, own[0], angle=False)),
        *_reasons("above_floor", _above_floor(case, known.rotation, own[1], angle=True) if angles else ()),
    )
    if not any(reason.kind in ("rejected", "above_floor") for reason in reasons):
        reasons = (*reasons, *_reasons("above_floor", worse_outside(case, known, grounds.outside)))
    # what scatters meets a tolerance as well as what is predictable does, unless the largest of it was left out
    tail: ReasonKind = "cut_off" if case.wrong.any() else "predictable"
    # what is predictable, or falls into groups, is no scatter
    if not grounds.rejected_runs and all(r.kind in ("rejected", "above_floor") or r in loose for r in reasons):
        reasons = (*reasons, *_reasons("predictable", _uneven(case)), *_reasons(tail, _scatter(case, stated)))
    elif not grounds.rejected_runs and all(r.kind in ("rejected", "above_floor", "predictable") for r in reasons):
        reasons = (*reasons, *_reasons(tail, _mostly_scatter(case, stated, seen)))
    told = known.position is not None and (known.rotation is not None or not angles)
    vague = "" if not told else _vague(known.position, own[0], " mm") or _vague(known.rotation, own[1], "°")
    unproven = "" if _scattered(known) else " ".join(grounds.unproven)
    status: Status = "open" if reasons else "at_floor" if told and not vague and not unproven else "cannot_tell"
    return Verdict(
        status=status,
        reasons=reasons,
        remedy=(unproven or vague or _remedy(known, angles, stated)) if status == "cannot_tell" else "",
        floor_mm=known.position.rms if known.position else None,
        floor_deg=known.rotation.rms if known.rotation else None,
        account_mm2=_account(case, parts, seen, own[0], known.position, angle=False),
        account_deg2=_account(case, parts, seen, own[1], known.rotation, angle=True) if angles else None,
        predictable=seen.position,
        predictable_deg=seen.rotation,
        predictable_both=seen.both,
        repeatability_mm=known.position.repeatability if known.position else Repeatability(None, None),
        repeatability_deg=known.rotation.repeatability if known.rotation else Repeatability(None, None),
        returns=known.returns,
        unproven=unproven,
    )


def _scattered(known: Floors) -> bool:
    """Whether postures that were visited again were read otherwise, as goals are not."""
    floor = known.position
    return floor is not None and floor.repeatability.source == "revisits" and floor.rms > 1e3 * FINEST


def _account(
    case: Case, parts: tuple[Contribution, ...], seen: Predictable, own: float, floor: Floor | None, angle: bool
) -> tuple[Row, ...]:
    return account(case, parts, seen.rotation if angle else seen.position, own, floor, angle)


def _reasons(kind: ReasonKind, sentences: Iterable[str]) -> Iterator[Reason]:
    return (Reason(kind, sentence) for sentence in sentences)


def _not_reached(grounds: Grounds) -> Iterator[str]:
    if not grounds.converged:
        yield "The fit did not converge: it stopped before it reached its minimum."


def _rejected(case: Case, grounds: Grounds) -> Iterator[str]:
    station = case.samples.station
    count, of = len(np.unique(station[case.wrong])), len(np.unique(station))
    if count > MAX_REJECTED * of:
        share = f"{count / of:.0%}; up to {MAX_REJECTED:.0%} may be wrong readings"
        yield f"{count} of {of} stations were rejected ({share})."
    for first, last in grounds.rejected_runs:
        yield f"Stations {first} to {last} were rejected in sequence: something was different there."
    for place in grounds.rejected_places if not grounds.rejected_runs else ():
        yield (
            f"{place.stations} stations next to each other, with {place.joint} between {place.low:.3g} and "
            f"{place.high:.3g}, were rejected: the model or the instrument errs there; more stations there would tell."
        )


def _not_applied(case: Case, grounds: Grounds) -> Iterator[str]:
    square = float(mean_square(case.errors["final"], angle=False).mean())
    for item in grounds.not_applied:
        if item.cost_mm2 > MAX_NOT_APPLIED * square:
            yield (
                f"The effect '{item.effect}' is not applied, because {item.why}; that costs {item.cost_mm2:.3g} mm² of "
                f"{square:.3g} mm²."
            )


def _predictable(seen: Predictable) -> Iterator[str]:
    share = seen.both
    if share is not None and share.lower99 > MAX_PREDICTABLE:
        yield (
            f"About {share.share:.0%} of the squared error that is left can be predicted from {seen.source} "
            f"(at least {share.lower99:.0%}, 99 %), and the model does not explain it."
        )


def _one_topic(case: Case) -> Iterator[str]:
    found = one_topic(case)
    if found is not None:
        yield found.sentence


def _along_motion(case: Case, stated: Stated | None) -> Iterator[str]:
    """Readings in motion that err along their way, unless it was stated what does not repeat."""
    found = None if stated is not None and stated.rms_mm is not None else along_motion(case)
    if found is not None:
        yield found.sentence


def _loose(case: Case, known: Floors, stated: Stated | None) -> Iterator[str]:
    """Returns that differ by more than arms do, unless it was stated that this one does."""
    stated = stated or Stated()
    limit = 1e3 * MAX_OF_REACH * case.model.chain.reach()
    for floor, most, own, unit in (
        (known.position, limit, stated.rms_mm, " mm"),
        (known.rotation, MAX_TURNED, stated.repeatability_deg, "°"),
    ):
        if floor is None or floor.repeatability.source != "revisits" or own is not None or floor.rms <= most:
            continue
        yield (
            f"Postures that were visited again differ by {floor.rms:.3g}{unit} RMS; an arm of this size repeats to "
            f"less than {most:.2g}{unit}. Check that base, tool and target are fixed and that no readings are mixed "
            "up; if the arm is like that, state its repeatability."
        )


def _two_groups(case: Case) -> Iterator[str]:
    found = two_groups(case)
    if found is not None:
        yield found.sentence


def _scatter(case: Case, stated: Stated | None) -> Iterator[str]:
    """A joint, base or tool that scatters by far more than the rest, unless it was stated what does not repeat."""
    found = None if stated is not None and stated.rms_mm is not None else one_joint(case) or one_place(case)
    if found is not None:
        yield found.sentence


def _mostly_scatter(case: Case, stated: Stated | None, seen: Predictable) -> Iterator[str]:
    """A joint that scatters by much of what is left even where all that is predictable is its own."""
    found = None if stated is not None and stated.rms_mm is not None else one_joint(case, LARGELY)
    if found is not None and seen.both is not None and found.share - seen.both.share >= LARGELY:
        yield found.sentence


def _uneven(case: Case) -> Iterator[str]:
    found = uneven(case)
    if found is not None:
        yield found.sentence


def _below_stated(case: Case, floor: Floor | None, angle: bool) -> Iterator[str]:
    """An error surely far below a floor that was stated: no model predicts what an arm does not repeat."""
    if floor is None or floor.repeatability.source != "stated":
        return
    station = case.samples.station[case.held_out]
    station = station[case.samples.is_pose[case.held_out]] if angle else station
    square, (_, high) = resampled(mean_square(case.errors["final"], angle), station)
    if high < floor.square / MAX_OVERSTATED**2:
        unit, what = ("°", "orientation") if angle else (" mm", "position")
        yield (
            f"{floor.rms:.3g}{unit} was stated for the {what} of arm and instrument together, and only "
            f"{np.sqrt(square):.3g}{unit} is left: the statement cannot be true, and does not give the floor. See "
            "whether it is in the right unit."
        )


def _above_floor(case: Case, floor: Floor | None, own: float, angle: bool) -> Iterator[str]:
    if floor is None:
        return
    station = case.samples.station[case.held_out]
    station = station[case.samples.is_pose[case.held_out]] if angle else station
    square, (low, _) = resampled(mean_square(case.errors["final"], angle), station)
    if low > MAX_ABOVE_FLOOR * floor.interval[1] + own:
        unit, what = ("°", "Orientation") if angle else (" mm", "Position")
        how = "returns show" if floor.repeatability.source == "revisits" else "was stated"
        yield (
            f"{what}: {np.sqrt(square):.3g}{unit} RMS is left, and {floor.rms:.3g}{unit} is what "
            f"{how} for the arm and the instrument."
        )


def _vague(floor: Floor | None, own: float, unit: str) -> str:
    """What to do where the parameters' own uncertainty surely leaves more than arm and instrument together."""
    if floor is None or own <= floor.interval[1]:
        return ""
    return (
        f"The parameters' uncertainty makes {np.sqrt(own):.3g}{unit} by itself, more than the {floor.rms:.3g}{unit} of "
        "arm and instrument, and hides what is left beside it: record more different postures."
    )


def _remedy(known: Floors, angles: bool, stated: Stated | None) -> str:
    stated = stated or Stated()
    ways = []
    if known.position is None or known.returns < MIN_RETURNS:
        seen = f" ({known.returns} so far)" if known.returns else ""
        ways.append(f"visit {MIN_RETURNS} of these postures twice, from another side the second time{seen}")
    missing = []
    if known.position is None:
        missing += ["the arm's repeatability"] if stated.rms_mm is None else []
        missing += ["the instrument's accuracy"] if stated.instrument_mm is None else []
    if angles and known.rotation is None:
        missing += ["the arm's repeatability in degrees"] if stated.repeatability_deg is None else []
        missing += ["the instrument's accuracy in degrees"] if stated.instrument_deg is None else []
    if missing:
        *others, last = missing
        ways.append(f"state {', '.join(others)}{' and ' * bool(others)}{last}")
    text = ", or ".join(ways)
    return f"To know how small the error can be: {text}." if text else ""

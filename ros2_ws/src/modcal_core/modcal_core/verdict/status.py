"""The status: open, at the floor, or cannot tell, with its reasons, in the order of ``docs/verdict.md``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from modcal_core.calibration import Stated
from modcal_core.measurements import MIN_RETURNS
from modcal_core.robots import is_serial_arm
from modcal_core.verdict.account import account
from modcal_core.verdict.along_motion import along_motion
from modcal_core.verdict.case import Case
from modcal_core.verdict.contributions import Contribution, contributions, mean_square
from modcal_core.verdict.floor import MIN_ASKED, Floor, Floors, floors
from modcal_core.verdict.grounds import Grounds
from modcal_core.verdict.one_joint import LARGELY, one_joint
from modcal_core.verdict.one_place import one_place
from modcal_core.verdict.one_topic import one_topic
from modcal_core.verdict.predictable import MIN_STATIONS, Predictable, predictable
from modcal_core.verdict.rejected import too_many
from modcal_core.verdict.tails import Tail, tail_of
from modcal_core.verdict.two_groups import two_groups
from modcal_core.verdict.uneven import uneven
from modcal_core.verdict.verdict import NotAsked, Reason, ReasonKind, Repeatability, Row, Status, Verdict

MAX_NOT_APPLIED = 0.10  # of E², that an effect which cannot be applied may cost: 5 % in RMS
MAX_PREDICTABLE = 0.05  # lower end (99 %) of the share of E² that is predictable: 2.5 % in RMS (sweep)
MAX_OF_REACH = 5e-4  # that returns may differ by; industrial arms repeat to some 1e-4 of their reach (ISO 9283 RP)
MAX_TURNED = 1.0  # deg; the same of orientations, which coarse instruments know to some tenths
MAX_OVERSTATED = 4.0  # times what is left, in RMS; data sheets give what is never exceeded, some three times the usual
_BOUNDED = 4.0  # of floor and parameters together, in E², that a few stations must surely lie below: twice in RMS
_FINDERS = 40  # stations from which each of those that look for one part that scatters has enough
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
    reach = case.model.chain.reach() if is_serial_arm(case.model.chain) else np.inf
    known = floors(case.residuals, case.samples, case.wrong, stated, reach)
    case = case.with_floor(*(None if floor is None else floor.rms for floor in (known.position, known.rotation)))
    angles = bool(case.samples.is_pose[case.held_out].any())
    position, rotation = tail_of(case, known.position, angle=False), tail_of(case, known.rotation, angle=True)
    seen = predictable(case)
    reasons = (
        *_reasons("not_converged", _not_reached(grounds)),
        *_reasons("rejected", _rejected(case, grounds)),
        *_reasons("not_applied", _not_applied(case, grounds)),
        *_reasons("contradiction", (*grounds.contradictions, *known.contradictions)),
        *(loose := tuple(_reasons("contradiction", _loose(case, known, stated)))),
        *_reasons("contradiction", _two_groups(case)),
        *_reasons("contradiction", _below_floor(position, angle=False)),
        *_reasons("contradiction", _below_floor(rotation, angle=True) if angles else ()),
        *_reasons("predictable", _predictable(seen)),
        *_reasons("predictable", _one_topic(case)),
        *_reasons("predictable", _along_motion(case, stated)),
        *_reasons("above_floor", _above_floor(position, angle=False)),
        *_reasons("above_floor", _above_floor(rotation, angle=True) if angles else ()),
    )
    if not any(reason.kind in ("rejected", "above_floor") for reason in reasons):
        reasons = (*reasons, *_reasons("above_floor", _worse_outside(case, position, grounds.outside)))
    # what scatters meets a tolerance as well as what is predictable does, unless the largest of it was left out
    tail: ReasonKind = "cut_off" if case.wrong.any() else "predictable"
    # what is predictable, or falls into groups, is no scatter
    if not grounds.rejected_runs and all(r.kind in ("rejected", "above_floor") or r in loose for r in reasons):
        reasons = (*reasons, *_reasons("predictable", _uneven(case)), *_reasons(tail, _scatter(case, stated)))
    elif not grounds.rejected_runs and all(r.kind in ("rejected", "above_floor", "predictable") for r in reasons):
        reasons = (*reasons, *_reasons(tail, _mostly_scatter(case, stated, seen)))
    told = known.position is not None and (known.rotation is not None or not angles)
    not_asked = (*grounds.not_asked, *_not_asked(case, known, seen))
    tails = [(position, " mm"), *([(rotation, "°")] if angles else [])]
    vague = next((said for tail, unit in tails if told and (said := _vague(tail, seen, unit))), "")
    unproven = " ".join(grounds.unproven) or " ".join(_spoken(n) for n in grounds.not_asked)
    status: Status = "open" if reasons else "at_floor" if told and not vague and not unproven else "cannot_tell"
    return Verdict(
        status=status,
        reasons=reasons,
        remedy=(unproven or vague or _remedy(known, angles, stated)) if status == "cannot_tell" else "",
        floor_mm=known.position.rms if known.position else None,
        floor_deg=known.rotation.rms if known.rotation else None,
        account_mm2=_account(case, parts, seen, position.estimation, known.position, angle=False),
        account_deg2=_account(case, parts, seen, rotation.estimation, known.rotation, angle=True) if angles else None,
        predictable=seen.position,
        predictable_deg=seen.rotation,
        predictable_both=seen.both,
        repeatability_mm=known.position.repeatability if known.position else Repeatability(None, None),
        repeatability_deg=known.rotation.repeatability if known.rotation else Repeatability(None, None),
        returns=known.returns,
        unproven=unproven,
        not_asked=not_asked,
    )


def _spoken(question: NotAsked) -> str:
    return f"It cannot be told {question.what}: that needs {question.needs}."


def _not_asked(case: Case, known: Floors, seen: Predictable) -> Iterator[NotAsked]:
    """What so few stations do not answer."""
    stations = case.samples.stations
    if seen.both is None:
        yield NotAsked("whether the rest can be predicted", f"{MIN_STATIONS} stations ({stations} so far)")
    if stations < _FINDERS:
        what = "whether one joint, the base or the tool scatters more than the others, or stands in two places"
        yield NotAsked(what, f"{_FINDERS} stations ({stations} so far)")
    if known.position is not None and 0 < known.position.returns < MIN_ASKED:
        needs = f"{MIN_ASKED} postures visited twice ({known.position.returns} so far)"
        yield NotAsked("whether what returns differ by depends on time, side or posture", needs)


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
    if too_many(case.wrong, case.samples):
        yield f"{count} of {of} stations were rejected ({count / of:.0%}): more than single wrong readings are."
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
        (known.seen[0], limit, stated.rms_mm, " mm"),
        (known.seen[1], MAX_TURNED, stated.repeatability_deg, "°"),
    ):
        if floor is None or own is not None or floor.rms <= most:
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


def _below_floor(tail: Tail, angle: bool) -> Iterator[str]:
    """An error surely far below the floor: no model predicts what an arm does not repeat."""
    floor = tail.floor
    if floor is None or not tail.below(MAX_OVERSTATED**2):
        return
    unit, what = ("°", "orientation") if angle else (" mm", "position")
    if floor.repeatability.source == "stated":
        yield (
            f"{floor.rms:.3g}{unit} was stated for the {what} of arm and instrument together, and only "
            f"{np.sqrt(tail.square):.3g}{unit} is left: the statement cannot be true, and does not give the floor. See "
            "whether it is in the right unit."
        )
    else:
        yield (
            f"Postures that were visited again differ by {floor.rms:.3g}{unit} in {what}, and only "
            f"{np.sqrt(tail.square):.3g}{unit} is left of what no fit has seen: these readings are copies of others."
        )


def _above_floor(tail: Tail, angle: bool) -> Iterator[str]:
    floor = tail.floor
    if floor is None or not tail.above(MAX_ABOVE_FLOOR):
        return
    unit, what = ("°", "Orientation") if angle else (" mm", "Position")
    how = "returns show" if floor.repeatability.source == "revisits" else "was stated"
    yield (
        f"{what}: {np.sqrt(tail.square):.3g}{unit} RMS is left, and {floor.rms:.3g}{unit} is what "
        f"{how} for the arm and the instrument."
    )


def _worse_outside(case: Case, tail: Tail, outside: tuple[str, ...]) -> Iterator[str]:
    """A frozen model that misses by more than it did on its own recording, and is used outside of it.

    Few returns know the floor to a factor of two; how far a calibration missed where it was made is known far better.
    """
    own = 1e6 * 3.0 * case.noise.position**2
    here = max(own, tail.floor.square if tail.floor else 0.0)
    if case.fitted or not outside:
        return
    if replace(tail, floor=Floor(here, Repeatability(None, None), 0.0)).above(MAX_ABOVE_FLOOR):
        yield (
            f"Position: {np.sqrt(tail.square):.3g} mm RMS is left, and {np.sqrt(own):.3g} mm was on the calibration's "
            f"own recording, and it is used outside that recording here. {' '.join(outside)}"
        )


def _vague(tail: Tail, seen: Predictable, unit: str) -> str:
    """What to do where parameters hide what is left, or where so few stations do not show that it is small."""
    floor = tail.floor
    if floor is None:
        return ""
    if tail.estimation > floor.interval[1]:
        return (
            f"The parameters' uncertainty makes {np.sqrt(tail.estimation):.3g}{unit} by itself, more than the "
            f"{floor.rms:.3g}{unit} of arm and instrument, and hides what is left beside it: record more different "
            "postures."
        )
    # what could not be asked may be as large as the stations leave room for
    times = MAX_ABOVE_FLOOR if seen.both is None else _BOUNDED
    if tail.upper > times * (floor.interval[1] + tail.estimation):
        many = f"{tail.postures} posture{'s' if tail.postures != 1 else ''}"
        return (
            f"{np.sqrt(tail.square):.3g}{unit} is left at {many}, which say only that it is below "
            f"{np.sqrt(tail.upper):.3g}{unit} (95 %), beside {floor.rms:.3g}{unit} of arm and instrument: record more "
            "different postures."
        )
    return ""


def _remedy(known: Floors, angles: bool, stated: Stated | None) -> str:
    stated = stated or Stated()
    ways = []
    if known.unknown:
        ways.append(known.unknown)
    elif known.position is None or known.returns < MIN_RETURNS:
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
    if known.unknown and known.position is None:
        return " ".join(ways[:1] if len(ways) == 1 else [ways[0], f"Else {', or '.join(ways[1:])}."])
    text = ", or ".join(ways)
    return f"To know how small the error can be: {text}." if text else ""

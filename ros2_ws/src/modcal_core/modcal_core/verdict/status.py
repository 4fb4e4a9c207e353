"""The status: open, at the floor, or cannot tell, with its reasons, in the order of ``docs/verdict.md``.

What may be wrong is a list of checks. Each sees all that is known and gives a sentence for what it finds; some are not
asked where another found what would show in them, too. Any finding makes a verdict open.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import Stated
from modcal_core.hypotheses import disagreement
from modcal_core.measurements import MIN_RETURNS, spread_rows
from modcal_core.robots import is_serial_arm
from modcal_core.verdict.account import Contribution, account, contributions_of, mean_square
from modcal_core.verdict.case import Case
from modcal_core.verdict.drivers import MIN_OF_FRAME
from modcal_core.verdict.floor import MIN_ASKED, Floor, Floors, floors
from modcal_core.verdict.grounds import Grounds, too_many
from modcal_core.verdict.predictable import MIN_STATIONS, Predictable, predictable
from modcal_core.verdict.scatter import MIN_STATIONS as MIN_SCATTERED
from modcal_core.verdict.scatter import scatter, two_values
from modcal_core.verdict.tails import Tail, tail_of
from modcal_core.verdict.verdict import NotAsked, Reason, ReasonKind, Repeatability, Status, Verdict

MAX_NOT_APPLIED = 0.10  # of E², that an effect which cannot be applied may cost: 5 % in RMS
MAX_OF_REACH = 5e-4  # that returns may differ by; industrial arms repeat to some 1e-4 of their reach (ISO 9283 RP)
MAX_TURNED = 1.0  # deg; the same of orientations, which coarse instruments know to some tenths
MAX_OVERSTATED = 4.0  # times what is left, in RMS; data sheets give what is never exceeded, some three times the usual
_BOUNDED = 4.0  # of floor and parameters together, in E², that a few stations must surely lie below: twice in RMS
MAX_ABOVE_FLOOR = 1.44  # E² in units of F²: a fifth more in RMS, about what six returns know a floor to (sweep)


_BESIDE, _LEAST_BESIDE = 4, 12  # stations that agree, for each that does not and at the least, which a search sees


@dataclass(frozen=True)
class Findings:
    """What checks see. known: floors. tails: of positions, and of orientations where there are any, with their units.
    mean: what of the rest is predictable.
    """

    case: Case
    grounds: Grounds
    stated: Stated
    known: Floors
    tails: tuple[tuple[Tail, str], ...]
    mean: Predictable


@dataclass(frozen=True)
class Check:
    """Something that may be wrong. look: sentences on it. unless: checks of which a finding makes this one idle; a rest
    that falls apart, or is predictable, is no scatter.
    """

    kind: ReasonKind
    look: Callable[[Findings], Iterable[str]]
    unless: tuple[Callable[[Findings], Iterable[str]], ...] = ()


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
    grounds, stated = grounds or Grounds(), stated or Stated()
    if not len(case.held_out):
        return Verdict("cannot_tell", remedy="Record more stations: none was left for the score.")
    parts = contributions_of(case) if parts is None else parts
    reach = case.model.chain.reach() if is_serial_arm(case.model.chain) else np.inf
    known = floors(case.residuals, case.samples, case.wrong, stated, reach)
    case = case.with_floor(*(None if floor is None else floor.rms for floor in (known.position, known.rotation)))
    angles = bool(case.samples.is_pose[case.held_out].any())
    position, rotation = tail_of(case, known.position, angle=False), tail_of(case, known.rotation, angle=True)
    tails = ((position, " mm"), *([(rotation, "°")] if angles else []))
    seen = Findings(case, grounds, stated, known, tails, predictable(case))
    reasons: list[Reason] = []
    found: set[Callable[[Findings], Iterable[str]]] = set()
    for check in CHECKS:
        if not found.intersection(check.unless):
            said = [Reason(check.kind, sentence) for sentence in check.look(seen)]
            found |= {check.look} if said else set()
            reasons += said
    told = known.position is not None and (known.rotation is not None or not angles)
    hidden = (_vague(tail, seen.mean, unit) for tail, unit in tails if told)
    vague = next(filter(None, hidden), "")
    unproven = " ".join(grounds.unproven) or " ".join(_spoken(n) for n in grounds.not_asked)
    status: Status = "open" if reasons else "at_floor" if told and not vague and not unproven else "cannot_tell"
    mean = seen.mean
    return Verdict(
        status=status,
        reasons=tuple(reasons),
        remedy=(unproven or vague or _remedy(known, angles, stated)) if status == "cannot_tell" else "",
        floor_mm=known.position.rms if known.position else None,
        floor_deg=known.rotation.rms if known.rotation else None,
        account_mm2=account(case, parts, mean.position, position.estimation, known.position, angle=False),
        account_deg2=account(case, parts, mean.rotation, rotation.estimation, known.rotation, True) if angles else None,
        predictable=mean.position,
        predictable_deg=mean.rotation,
        predictable_both=mean.both,
        repeatability_mm=known.position.repeatability if known.position else Repeatability(None, None),
        repeatability_deg=known.rotation.repeatability if known.rotation else Repeatability(None, None),
        returns=known.returns,
        source=mean.source if mean.sure else "",
        unproven=unproven,
        not_asked=(*grounds.not_asked, *_not_asked(seen)),
    )


def _not_reached(seen: Findings) -> Iterator[str]:
    if not seen.grounds.converged:
        yield "The fit did not converge: it stopped before it reached its minimum."


def _many_rejected(seen: Findings) -> Iterator[str]:
    station, wrong = seen.case.samples.station, seen.case.wrong
    count, of = len(np.unique(station[wrong])), len(np.unique(station))
    if too_many(wrong, seen.case.samples):
        yield f"{count} of {of} stations were rejected ({count / of:.0%}): more than single wrong readings are."


def _rejected_in_sequence(seen: Findings) -> Iterator[str]:
    for first, last in seen.grounds.rejected_runs:
        yield f"Stations {first} to {last} were rejected in sequence: something was different there."


def _rejected_at_a_joint(seen: Findings) -> Iterator[str]:
    for place in seen.grounds.rejected_places:
        yield (
            f"{place.stations} stations next to each other, with {place.joint} between {place.low:.3g} and "
            f"{place.high:.3g}, were rejected: the model or the instrument errs there; more stations there would tell."
        )


def _rejected_alike(seen: Findings) -> Iterator[str]:
    """Rejected stations that one mistake explains, beside some others: those are no single wrong readings."""
    case, wrong = seen.case, np.flatnonzero(seen.case.wrong & ~seen.case.samples.moving)
    if len(wrong) < 2 or not is_serial_arm(case.model.chain) or too_many(case.wrong, case.samples):
        return
    others = np.flatnonzero(~case.wrong)
    others = others[spread_rows(len(others), max(_BESIDE * len(wrong), _LEAST_BESIDE))]
    found = disagreement(case.samples.select(np.sort(np.r_[wrong, others])), case.model.chain)
    if found is not None and 1 < found.stations <= len(wrong):
        what = f"{found.stations} of {len(wrong)} stations that were rejected are no single wrong readings"
        yield f"{what}: {found.what}. {found.remedy[0].upper()}{found.remedy[1:]}."


def _not_applied(seen: Findings) -> Iterator[str]:
    square = float(mean_square(seen.case.errors["final"], angle=False).mean())
    for item in seen.grounds.not_applied:
        if item.cost_mm2 > MAX_NOT_APPLIED * square:
            yield (
                f"The effect '{item.effect}' is not applied, because {item.why}; that costs {item.cost_mm2:.3g} mm² of "
                f"{square:.3g} mm²."
            )


def _contradicted(seen: Findings) -> Iterable[str]:
    return (*seen.grounds.contradictions, *seen.known.contradictions)


def _loose(seen: Findings) -> Iterator[str]:
    """Returns that surely differ by more than arms do, unless it was stated that this one does."""
    limit = 1e3 * MAX_OF_REACH * seen.case.model.chain.reach()
    for floor, most, own, unit in (
        (seen.known.seen[0], limit, seen.stated.rms_mm, " mm"),
        (seen.known.seen[1], MAX_TURNED, seen.stated.repeatability_deg, "°"),
    ):
        if floor is None or own is not None or floor.interval[0] <= most**2:  # few returns know it to a half
            continue
        yield (
            f"Postures that were visited again differ by {floor.rms:.3g}{unit} RMS; an arm of this size repeats to "
            f"less than {most:.2g}{unit}. Check that base, tool and target are fixed and that no readings are mixed "
            "up; if the arm is like that, state its repeatability."
        )


def _two_values(seen: Findings) -> Iterator[str]:
    if seen.mean.rest is not None:
        yield from filter(None, [two_values(seen.mean.rest, seen.case.fitted)])


def _predictable(seen: Findings) -> Iterator[str]:
    share = seen.mean.both
    if share is not None and seen.mean.sure:
        yield (
            f"About {share.share:.0%} of the squared error that is left can be predicted from {seen.mean.source} "
            f"(at least {share.lower99:.0%}, 99 %), and the model does not explain it."
        )


def _below_floor(seen: Findings) -> Iterator[str]:
    """An error surely far below the floor: no model predicts what an arm does not repeat."""
    for tail, unit in seen.tails:
        floor, what = tail.floor, "orientation" if unit == "°" else "position"
        if floor is None or not tail.below(MAX_OVERSTATED**2):
            continue
        if floor.repeatability.source == "stated":
            yield (
                f"{floor.rms:.3g}{unit} was stated for the {what} of arm and instrument together, and only "
                f"{np.sqrt(tail.square):.3g}{unit} is left: the statement cannot be true, and does not give the floor. "
                "See whether it is in the right unit."
            )
        else:
            yield (
                f"Postures that were visited again differ by {floor.rms:.3g}{unit} in {what}, and only "
                f"{np.sqrt(tail.square):.3g}{unit} is left of what no fit has seen: these readings are copies of "
                "others."
            )


def _above_floor(seen: Findings) -> Iterator[str]:
    for tail, unit in seen.tails:
        if tail.floor is None or not tail.above(MAX_ABOVE_FLOOR):
            continue
        what = "Orientation" if unit == "°" else "Position"
        how = "returns show" if tail.floor.repeatability.source == "revisits" else "was stated"
        yield (
            f"{what}: {np.sqrt(tail.square):.3g}{unit} RMS is left, and {tail.floor.rms:.3g}{unit} is what "
            f"{how} for the arm and the instrument."
        )


def _worse_outside(seen: Findings) -> Iterator[str]:
    """A frozen model that misses by more than it did on its own recording, and is used outside of it.

    Few returns know the floor to a factor of two; how far a calibration missed where it was made is known far better.
    """
    tail, outside = seen.tails[0][0], seen.grounds.outside
    own = 1e6 * 3.0 * seen.case.noise.position**2
    here = max(own, tail.floor.square if tail.floor else 0.0)
    if seen.case.fitted or not outside:
        return
    if replace(tail, floor=Floor(here, Repeatability(None, None), 0.0)).above(MAX_ABOVE_FLOOR):
        yield (
            f"Position: {np.sqrt(tail.square):.3g} mm RMS is left, and {np.sqrt(own):.3g} mm was on the calibration's "
            f"own recording, and it is used outside that recording here. {' '.join(outside)}"
        )


def _whole_scatter(seen: Findings) -> Iterator[str]:
    # what scatters meets a tolerance as well as what is predictable does, unless the largest of it was left out
    return _scatter(seen, cut_off=False)


def _cut_scatter(seen: Findings) -> Iterator[str]:
    return _scatter(seen, cut_off=True)


def _scatter(seen: Findings, cut_off: bool) -> Iterator[str]:
    """A place that scatters by far more than the rest, unless it was stated what does not repeat."""
    mean = seen.mean
    if seen.stated.rms_mm is None and mean.rest is not None and bool(seen.case.wrong.any()) == cut_off:
        shown = [t.floor.interval[1] / max(t.square, 1e-300) for t, _ in seen.tails if t.floor and t.floor.freedom]
        found = scatter(mean.rest, mean.predicted if mean.sure else None, max(shown, default=np.inf))
        yield from filter(None, [found])


_REJECTED = (_many_rejected, _rejected_in_sequence, _rejected_at_a_joint)
_APART = (_not_reached, _rejected_in_sequence, _not_applied, _contradicted, _two_values)
CHECKS = (
    Check("not_converged", _not_reached),
    Check("rejected", _many_rejected),
    Check("rejected", _rejected_in_sequence),
    Check("rejected", _rejected_at_a_joint, unless=(_rejected_in_sequence,)),
    Check("rejected", _rejected_alike),
    Check("not_applied", _not_applied),
    Check("contradiction", _contradicted),
    Check("contradiction", _loose),
    Check("contradiction", _two_values),
    Check("contradiction", _below_floor),
    Check("predictable", _predictable),
    Check("above_floor", _above_floor),
    Check("above_floor", _worse_outside, unless=(*_REJECTED, _above_floor)),
    Check("predictable", _whole_scatter, unless=(*_APART, _below_floor)),
    Check("cut_off", _cut_scatter, unless=(*_APART, _below_floor)),
)


def _spoken(question: NotAsked) -> str:
    return f"It cannot be told {question.what}: that needs {question.needs}."


def _not_asked(seen: Findings) -> Iterator[NotAsked]:
    """What so few stations do not answer."""
    samples, returns = seen.case.samples, seen.known.position
    stations, read = samples.stations, np.bincount(samples.frame, minlength=len(samples.frames))
    if seen.mean.both is None:
        yield NotAsked("whether the rest can be predicted", f"{MIN_STATIONS} stations ({stations} so far)")
    if stations < MIN_SCATTERED:
        what = "whether one joint, the base or the tool scatters more than the others, or stands in two places"
        yield NotAsked(what, f"{MIN_SCATTERED} stations ({stations} so far)")
    few = [name for name, count in zip(samples.frames, read, strict=True) if 0 < count < MIN_OF_FRAME]
    if few and len(samples.frames) > 1 and not samples.sockets:
        what = f"whether the readings in {', '.join(few)} agree with the others in scale, shape and target"
        yield NotAsked(what, f"{MIN_OF_FRAME} readings of each")
    if returns is not None and 0 < returns.returns < MIN_ASKED:
        needs = f"{MIN_ASKED} postures visited twice ({returns.returns} so far)"
        yield NotAsked("whether what returns differ by depends on time, side or posture", needs)
    for floor, unit in zip(seen.known.seen, (" mm", "°"), strict=True):
        if floor is not None and floor.refused:
            what = f"whether returns that differ by up to {floor.refused:.2g}{unit}, and are left out of the floor, are"
            yield NotAsked(f"{what} wrong readings", "a third visit to these postures")


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


def _remedy(known: Floors, angles: bool, stated: Stated) -> str:
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

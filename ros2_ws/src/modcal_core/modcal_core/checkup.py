"""The check-up: a frozen calibration at a few new stations, what changed since, and the model with that repaired."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from modcal_core.calibration import BLEND, Calibration, Cell, Errors, curved_joints, errors, with_sockets
from modcal_core.errors import BadRecording, NotEnoughData
from modcal_core.evaluation import evaluate
from modcal_core.geometry import Array
from modcal_core.hypotheses import recognised
from modcal_core.measurements import Samples
from modcal_core.moves import (
    PATTERN,
    UNTRIED,
    BeyondRanges,
    FoundChanges,
    NamedChange,
    Noticed,
    Recommendation,
    advise,
    alike_everywhere,
    beyond_ranges,
    frozen,
    in_known_frames,
    named,
    new_frames,
    newly_placed,
    noticed,
    repaired,
    require_accounted,
    search,
    spread_out,
    with_new_frames,
)
from modcal_core.outcome import Outcome, counted, unseen_note
from modcal_core.verdict import Applied, applicable, on_joints_clock, own_rows

Status = Literal["unchanged", "changed", "ambiguous", "unexplained"]
MIN = 5  # stations; of fewer, six sizes of a base leave nothing to tell it from others by
_SAME_POSTURE = 1e-3  # rad or m; no change of interest shows between two stations that close
_NAMED = 4  # frames that a note has room for
_DATES = 1.2e9  # s since 1970: 2008. No ROS recorded before
MAX = 48  # stations of a longer recording that are looked at


@dataclass(frozen=True)
class Checked:
    """Outcome of a check.

    - changes: the named changes. chance: upper bound of the probability of such a result without any change.
    - before, after: RMS position [mm] and orientation [deg] at the stations by the frozen and the repaired model.
    - expected: what the frozen model should show without a change. noticed: smallest changes that would be found.
    - aside: numbers of stations set aside as wrong. beyond: how many stand outside the calibrated ranges.
    - repaired: the frozen model with only the named changes; None without changes, or where repair is not possible.
    - report: of the repaired model, or else the frozen one, at these stations, each predicted from the others.
    - joints: names, in the order of the stations' columns.
    - station_errors: distances [m] of every reading before and after the repair.
    - far_apart: number of independent stations that these count as.
    - placed: frames unknown to the calibration, which these stations placed.
    """

    status: Status
    changes: tuple[NamedChange, ...]
    chance: float
    before: tuple[float | None, float | None]
    after: tuple[float | None, float | None]
    expected: tuple[float | None, float | None]
    stations: int
    aside: tuple[int, ...]
    noticed: tuple[Noticed, ...]
    advice: Recommendation
    repaired: Calibration | None
    report: Outcome
    joints: tuple[str, ...]
    convention: str | None = None
    notes: tuple[str, ...] = ()
    station_errors: tuple[Array, Array] | None = None
    far_apart: float = np.inf
    placed: tuple[str, ...] = ()
    beyond: BeyondRanges | None = None

    @property
    def alike(self) -> bool:
        """Whether the stations count as less than half of their number."""
        return 2.0 * self.far_apart < self.stations

    @property
    def sentence(self) -> str:
        """The answer as a sentence."""
        seen = counted(self.stations, "station")
        if self.status == "unchanged":
            said = "No change is seen" if self.alike else "Nothing has changed"
            worth = f" that say as much as {self.far_apart:.1f} far apart" if self.alike else ""
            new = self.placed[0] if len(self.placed) == 1 else f"{len(self.placed)} new frames"
            where = f"; the place of {new} was found from them" if self.placed else ""
            return f"{said}, by {seen}{worth}{where}."
        unexplained = self.status == "unexplained"
        said = " ".join(change.sentence for change in self.changes if change.likely or not unexplained)
        if not unexplained:
            return f"{said} ({seen}.)"
        what = f"Something has changed that no single change or pair of changes explains, by {seen}."
        if self.beyond is not None and self.beyond.mostly:
            what = (
                f"The readings are not those that are expected, and no change or pair of changes explains them: "
                f"{self.beyond.outside} of {seen} stand beyond the joint ranges of the calibration, which may be "
                "what is wrong there."
            )
        return what + (f" Nearest: {said}" if said else "")


def checkup(
    calibration: Calibration,
    samples: Samples,
    rng: np.random.Generator,
    cell: Cell | None = None,
    pattern: float = PATTERN,
) -> Checked:
    """What has changed since the calibration, by these samples.

    pattern: share of the calibration's noise that neighbouring postures have in common (its predictable share). Raises
    NotEnoughData for too few stations, BadTable for unknown frames whose readings do not place them, BadRecording for
    what is not of this robot.
    """
    cell = (cell or Cell()).met(samples)
    samples = with_sockets(samples, cell, calibration.nominal.chain)
    recorded, (samples, late) = samples, on_joints_clock(calibration, samples)
    if (count := distinct_postures(samples)) < MIN:
        again = "" if count == samples.stations else f" at {count} posture{'s' if count > 1 else ''}"
        said = f"at least {MIN} postures are needed to tell changes apart"
        remedy = "measure ten stations, spread over the ranges of all joints"
        raise NotEnoughData(f"{samples.stations} stations{again}", said, remedy)
    new = new_frames(calibration, samples)
    placed = _placed(calibration, samples, new)
    samples = in_known_frames(samples, placed[0])
    known = recognised(placed[1].model, samples, calibration.noise)
    if new and known.undone is not None:  # they were placed by what was undone
        placed = _placed(calibration, known.samples, new)
    samples, (calibration, applied) = known.samples, placed
    model, knowledge = applied.model, frozen(calibration, applied.model, pattern)
    inside = _where_curves_are_known(calibration, samples)
    part = calibration.with_scatter(spread_out(inside, MAX))
    try:
        found = search(model, part, knowledge, newly_placed(part, new))
    except np.linalg.LinAlgError:  # so far apart that their likelihoods cannot be weighed
        raise BadRecording(
            "readings",
            f"miss the calibrated arm by {_size(errors(model, part))[0]:.3g} mm RMS, and contradict each other",
            "check that each stands beside its own posture, and that robot and instrument are those of the calibration",
        ) from None
    require_accounted(found, part, known.doubt, model)
    fixed = None if found.more else repaired(calibration, found)
    alike = [alike_everywhere(c, calibration, model, found.samples) for c in found.changes]
    beyond = beyond_ranges(calibration, model, found.samples)
    changes = tuple(
        named(change, _motions(found, i), 3 * len(found.samples), same, beyond.untried_mm)
        for i, (change, same) in enumerate(zip(found.changes, alike, strict=True))
    )
    untried = any(UNTRIED in c.same_as for c in changes) or (found.more and beyond.mostly)
    report = evaluate(fixed or calibration, found.samples, rng, cell=cell)
    if fixed is not None:
        fixed = replace(fixed, claim_mm=None if report.claim is None else report.claim.mm["p95"].ci95[1])
        report = _each_by_the_others(report, found)
    before, after = errors(model, found.samples), errors(found.state.model, found.samples)
    return Checked(
        status=_status(found, changes),
        changes=changes,
        chance=float(np.exp(min(0.0, -found.log_e[0]))),
        before=_size(before),
        after=_size(after),
        expected=_expected(found),
        stations=part.stations,
        aside=tuple(int(part.station[i]) + 1 for i in sorted(found.aside)),
        noticed=noticed(found),
        advice=advise(found, calibration, alike, untried),
        repaired=fixed,
        report=report,
        joints=samples.names,
        convention=known.undone,
        notes=(
            *late,
            *_placed_note(calibration, samples, new),
            *_notes(calibration, samples, inside, part, found),
            *_dated(calibration, recorded),
            *unseen_note(found.samples, calibration),
            *applied.notes,
        ),
        station_errors=(before.position_norm, after.position_norm),
        far_apart=found.plain.null.weight * part.stations,
        placed=new,
        beyond=beyond,
    )


def _placed(calibration: Calibration, samples: Samples, new: tuple[str, ...]) -> tuple[Calibration, Applied]:
    """The calibration with these frames that it does not know where the samples place them, and what of it applies."""
    applied = applicable(calibration, samples)
    if not new:
        return calibration, applied
    calibration = with_new_frames(calibration, applied.model, samples, new)
    return calibration, applicable(calibration, samples)


def distinct_postures(samples: Samples) -> int:
    """At how many postures the stations stand: those within a milliradian, or a millimetre, are one."""
    left = samples.q[np.unique(samples.station, return_index=True)[1]]
    count = 0
    while len(left):
        left = left[np.abs(left - left[0]).max(axis=1) > _SAME_POSTURE]
        count += 1
    return count


def _where_curves_are_known(calibration: Calibration, samples: Samples) -> Samples:
    """The samples whose joints with a learned curve are where that was seen; all, where too few are left.

    Beyond that the curve is another one, or none, and what it leaves is no change.
    """
    free = tuple(effect for effect in calibration.calibrated.effects if effect.shape.is_free)
    curved = curved_joints(free, calibration.nominal.chain.names)
    low, high = calibration.seen
    beyond = ((samples.q < low - BLEND) | (samples.q > high + BLEND)) & curved
    left = samples.select(np.flatnonzero(~beyond.any(axis=1)))
    return left if left.stations >= MIN else samples


def _status(found: FoundChanges, changes: tuple[NamedChange, ...]) -> Status:
    if found.more:
        return "unexplained"
    if not changes:
        return "unchanged"
    return "changed" if all(c.alike for c in changes) else "ambiguous"


def _motions(found: FoundChanges, i: int) -> np.ndarray:
    """Motions of the readings per unit of each size of a change; of a curve, per unit of each station's angle."""
    h = found.changes[i].hypothesis
    if h.curve >= 0:
        return found.state.turned(h.curve)
    return found.state.columns(h) if h.sizes else np.zeros((0, 0))


def _size(e: Errors) -> tuple[float | None, float | None]:
    mm, deg = e.size_mm(), e.size_deg()
    return None if mm is None else mm.rms, None if deg is None else deg.rms


def _expected(found: FoundChanges) -> tuple[float | None, float | None]:
    """RMS that the frozen model should show while nothing has changed."""
    null = found.plain.null
    variance = np.diag(null.covariances[null.reference])
    turned = null.rows.component >= 3
    position = 1e3 * float(np.sqrt(3.0 * variance[~turned].mean()))
    return position, float(np.degrees(np.sqrt(3.0 * variance[turned].mean()))) if turned.any() else None


def _each_by_the_others(report: Outcome, found: FoundChanges) -> Outcome:
    """The report with each station predicted by a repair that has not seen it: its sizes are those of the others."""
    state, N = found.state, len(found.samples)
    sized = [c.hypothesis for c in (*found.given, *found.changes) if c.hypothesis.sizes]
    if not sized or report.errors["final"].lever is not None or len(report.scored) != N:
        return report
    A = np.concatenate([state.columns(h) for h in sized], axis=1)
    V = found.plain.null.covariances[state.judge.best]
    residual, rows = state.view.residual, found.plain.null.rows
    station = found.samples.station[rows.sample]
    left = residual.copy()
    for one in np.unique(station):
        out = station == one
        L = np.linalg.cholesky(V[np.ix_(~out, ~out)])
        step = np.linalg.lstsq(np.linalg.solve(L, A[~out]), np.linalg.solve(L, residual[~out]), rcond=1e-9)[0]
        left[out] = residual[out] - A[out] @ step
    final = Errors(left[: 3 * N].reshape(3, N).T, left[3 * N :].reshape(3, len(state.view.pose)).T)
    return replace(report, errors={**report.errors, "final": final})


def _notes(
    calibration: Calibration, samples: Samples, inside: Samples, part: Samples, found: FoundChanges
) -> tuple[str, ...]:
    out = []
    if calibration.uncertainty is None:
        out.append("The calibration keeps no covariance: what it does not know of itself was not counted.")
    if inside.stations < samples.stations:
        gone = samples.stations - inside.stations
        out.append(f"{gone} of {samples.stations} stations were left out: learned curves have not been seen there.")
    if part.stations < inside.stations:
        out.append(f"{part.stations} of {inside.stations} stations, spread over time and postures, were looked at.")
    if 2.0 * (far := found.plain.null.weight * part.stations) < part.stations:
        out.append(
            f"These {part.stations} stations stand close together and say as much as {far:.1f} far apart: only larger "
            "changes are named. Spread them over the ranges of all joints."
        )
    if "" in found.aside.values():
        out.append("A reading that no change explains was set aside as wrong.")
    for label in sorted({*found.aside.values()} - {""}):
        at = ", ".join(str(part.station[i] + 1) for i, said in sorted(found.aside.items()) if said == label)
        out.append(f"Stations {at} were set aside: {label}, to the last digit, and elsewhere by the readings.")
    return tuple(out)


def _placed_note(calibration: Calibration, samples: Samples, new: tuple[str, ...]) -> tuple[str, ...]:
    """Sentences for frames whose place was found."""
    sockets = [name for name in new if samples.is_same_point(samples.frames.index(name))]
    out = []
    if sockets:
        which = f"Socket {sockets[0]} is" if len(sockets) == 1 else f"{len(sockets)} sockets are"
        out.append(f"{which} not in the calibration: where they are was found from these stations.")
    old = [known for known in calibration.frames if known not in new]
    known = ", ".join(old[:_NAMED]) + (f" and {len(old) - _NAMED} more" if len(old) > _NAMED else "")
    return tuple(out) + tuple(
        f"Frame {name} is not in the calibration, which has {known}: its place was found from these stations; a moved "
        "base cannot be told there. Of another instrument with a target of its own, a moved tool is that target."
        for name in new
        if name not in sockets
    )


def _dated(calibration: Calibration, samples: Samples) -> tuple[str, ...]:
    """A sentence for a recording that is not later than the calibration's own, by its readings, or by the stamps of
    both; none by stamps that are a simulation's, or count from when a machine was switched on.
    """
    own = own_rows(samples, calibration)
    if own.contradictions or own.unproven:
        return (*own.contradictions, *own.unproven)
    if calibration.watched is None or not (calibration.clock and samples.clock):
        return ()
    first, last = calibration.watched
    if min(first, float(samples.stamps.min())) < _DATES:
        return ()
    if samples.stamps.max() < first:
        return ("By its stamps this recording is older than the calibration's: what changed was otherwise before.",)
    if samples.stamps.min() >= first and samples.stamps.max() <= last:
        return ("By its stamps this is a part of the calibration's own recording, which cannot show a change.",)
    return ()

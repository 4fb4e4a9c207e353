"""The score on what no fit has seen, the model to ship, fitted to all of it, and the verdict."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import (
    Calibration,
    Errors,
    KnownDistance,
    Model,
    distances_of,
    errors,
    finalise,
    identifiability,
    places_of,
    readmitted,
    rejected,
    right_after_all,
    runs_of,
)
from modcal_core.claim import Claim, claim_at_tool, settled
from modcal_core.diagnosis import located
from modcal_core.effects import Effect
from modcal_core.measurements import Samples
from modcal_core.outcome import (
    Finding,
    Outcome,
    Step,
    description_note,
    findings,
    instrument_notes,
    load_findings,
    load_notes,
    not_asked_note,
    offsets_of,
    readmitted_note,
    residual_notes,
    stated_note,
    unproved_note,
)
from modcal_core.task import Fits, Task
from modcal_core.verdict import (
    TOGETHER,
    Applied,
    Grounds,
    Verdict,
    carried_over,
    contradictions,
    contributions_of,
    fitted_case,
    judge,
    regimes_of,
    rejection,
    too_small,
    with_places,
)

_LOST = 0.1  # of the samples; where more are rejected beside a rest that is predictable, no cause is proved


@dataclass(frozen=True)
class _Scored:
    """wrong: samples that were rejected, (N,). accepted: held-out samples without those. errors: of them, by stage."""

    wrong: np.ndarray
    accepted: Samples
    errors: dict[str, Errors]
    distances: tuple[KnownDistance, ...]


def scored(task: Task, fits: Fits) -> tuple[Outcome, Calibration]:
    """The outcome on held-out samples, and the calibration to ship."""
    samples, sets, cell, final = task.samples, task.sets, task.cell, fits.final
    wrong = rejected(final, samples, sets.train, cell.distances)
    if wrong[sets.held_out].all():  # then it is the model that misses them
        wrong[sets.held_out] = False
    accepted = task.held_out.select(~wrong[sets.held_out])
    shipped, claim, again, carried = _shipped(task, fits, wrong)
    taken_in = readmitted(shipped.calibrated, samples, again, wrong)
    bare = {"nominal": fits.nominal.model, "geometric": fits.geometric.model}
    bare = {stage: model.with_effects(_stated(model, task)) for stage, model in bare.items()}
    left = {stage: errors(model, accepted) for stage, model in {**bare, "final": final.model}.items()}
    seen = _Scored(wrong, accepted, left, distances_of(final, task.train, cell.distances))
    grounds = replace(_grounds(task, fits, seen), not_applied=carried.not_applied)
    if not shipped.converged:
        grounds = replace(grounds, converged=False)
    case = fitted_case(final, samples, sets, wrong, left, cell.distances)
    parts = tuple(p for p in contributions_of(case) if not _is_stated((final.model.effects[p.effect],), task))
    judged = with_places(judge(case, grounds, cell.stated, parts), case, described=task.chain)
    found = (
        *findings(replace(fits.diagnosis, fit=final), shipped.calibrated, case),
        *load_findings(fits.loads, final.model, accepted),
    )
    stated = tuple(finding for finding in found if _is_stated(finding.effects, task))
    found = tuple(finding for finding in found if finding not in stated)
    proved = tuple(finding for finding in found if finding.shown and not _hidden(finding, judged, left["final"], wrong))
    unproved = tuple(finding for finding in found if finding not in proved)
    outcome = Outcome(
        samples=samples,
        sets=sets,
        scored=accepted,
        rejected=int(wrong.sum()),
        errors=left,
        effects=proved,
        unproved=unproved,
        left=(fits.diagnosis.left or located(final, samples)) if judged.may_depend else None,
        identifiability=identifiability(final),
        parameters=shipped.parameters,
        offsets=offsets_of(shipped),
        left_out=fits.chosen.left_out,
        notes=(
            *stated_note(stated),
            *description_note(errors(fits.nominal.model, accepted), task.chain),
            *instrument_notes(final),
            *load_notes(fits.loads),
            *unproved_note(unproved),
            *readmitted_note(taken_in),
            *residual_notes(case),
            *carried.notes,
            *not_asked_note(judged),
        ),
        readmitted=taken_in,
        steps=_steps(task, fits, left, accepted),
        evidence=fits.diagnosis.maps,
        model=final.model,
        residuals=case.residuals.position_norm,
        wrong=wrong,
        rejection=rejection(errors(final.model, task.held_out), wrong, samples, sets.held_out),
        distances=seen.distances,
        grounds=grounds,
        judged=judged,
        loads=fits.loads,
        claim=claim,
    )
    return outcome, shipped


def _hidden(finding: Finding, judged: Verdict, final: Errors, wrong: np.ndarray) -> bool:
    """Whether what the model lacks may be what an effect stands for: it brings less than what is surely predictable of
    the rest, or so many stations were rejected that the rest is none of what was looked for.
    """
    if not judged.predicted or judged.predictable is None or finding.gain_mm2 is None:
        return False
    if any(reason.kind == "rejected" for reason in judged.reasons) and wrong.mean() > _LOST:
        return True
    return finding.gain_mm2 < judged.predictable.share * 1e6 * float(np.mean(final.position_norm**2))


def _shipped(task: Task, fits: Fits, wrong: np.ndarray) -> tuple[Calibration, Claim, np.ndarray, Applied]:
    """(The model fitted to all accepted samples, its claim, rejected samples taken in, how it is carried over)."""
    samples, cell, parameters = task.samples, task.cell, fits.chosen.parameters
    again, whole = right_after_all(fits.final, samples, parameters, cell.distances, wrong)
    shipped = finalise(
        samples, task.chain, fits.chosen, cell, task.inertias, fits.final, wrong & ~again, task.regimes, fits.geometric,
        whole,
    )  # fmt: skip
    if fits.diagnosis.again is not None:
        again[task.sets.train] |= fits.diagnosis.again
    kept = samples.select(~wrong | again)
    shipped = settled(shipped, kept, cell)
    carried = carried_over(shipped, kept)
    claim = claim_at_tool(shipped, kept, cell, carried=carried.model if carried.not_applied else None)
    shipped = replace(
        shipped,
        uncertainty=claim.known or shipped.uncertainty,
        claim_mm=claim.mm["p95"].ci95[1],
        rivals=tuple(cause.rivals for cause in fits.diagnosis.causes),
    )
    return shipped, claim, again, carried


def _stated(model: Model, task: Task) -> tuple[Effect, ...]:
    """The moves of base and tool in a model that somebody stated: they belong to every model, and explain nothing."""
    return tuple(effect for effect in model.effects if task.cell.states(effect, task.samples.stamps))


def _is_stated(effects: tuple[Effect, ...], task: Task) -> bool:
    return bool(effects) and all(task.cell.states(effect, task.samples.stamps) for effect in effects)


def _steps(task: Task, fits: Fits, left: dict[str, Errors], accepted: Samples) -> tuple[Step, ...]:
    """What each thing that was added leaves of the accepted samples, the moves that were stated in all of them."""
    stated = _stated(fits.geometric.model, task)
    added = []
    for cause in fits.diagnosis.causes:
        if not task.cell.states(cause.effect, task.samples.stamps):
            known = _stated(cause.fit.model, task)
            missing = stated[: len(stated) - len(known)] if len(known) < len(stated) else ()
            model = cause.fit.model.with_effects((*cause.fit.model.effects, *missing))
            added.append(Step(cause.effect.label, errors(model, accepted)))
    if fits.together:
        added.append(Step(TOGETHER, left["final"]))
    elif added:
        added[-1] = replace(added[-1], errors=left["final"])  # what the final model leaves, its moments sharpened
    return (Step("geometry", left["geometric"]), *added)


def _grounds(task: Task, fits: Fits, seen: _Scored) -> Grounds:
    """What the verdict stands on beside the errors."""
    samples, cell, chain, final = task.samples, task.cell, task.chain, fits.final
    small = too_small(seen.errors, seen.accepted, samples, chain, cell.stated)
    against = contradictions(
        final, task.train, samples, seen.accepted, seen.wrong, seen.errors, seen.distances, cell, chain
    )
    return Grounds(
        converged=all(fit.converged for fit in (fits.nominal, fits.geometric, final)),
        regimes=regimes_of(final.model, samples),
        contradictions=(*small.contradictions, *against, *task.absurd),
        unproven=small.unproven,
        not_asked=small.not_asked,
        convention=task.convention,
        rejected_runs=runs_of(samples, seen.wrong),
        rejected_places=places_of(samples, seen.wrong),
    )

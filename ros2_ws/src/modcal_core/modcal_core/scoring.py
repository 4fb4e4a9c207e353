"""The score on what no fit has seen, the model to ship, fitted to all of it, and the verdict."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration import (
    Calibration,
    Errors,
    KnownDistance,
    Model,
    as_used,
    distances_of,
    errors,
    finalise,
    identifiability,
    places_of,
    readmitted,
    rejected,
    right_after_all,
    runs_of,
    squared_residuals,
)
from modcal_core.claim import Claim, claim_at_tool, settled
from modcal_core.diagnosis import located
from modcal_core.effects import Effect
from modcal_core.measurements import Samples
from modcal_core.outcome import (
    Outcome,
    Step,
    description_note,
    findings,
    instrument_notes,
    load_findings,
    load_notes,
    not_asked_note,
    offsets_of,
    one_instrument_notes,
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

_TIMES = 2.0  # that the model with effects misses a reading by more than geometry alone, where the reading is right


@dataclass(frozen=True)
class _Scored:
    """What stations that no fit has seen say. wrong: samples that were rejected, (N,). accepted: held-out samples
    without those. errors: of them, by stage.
    """

    wrong: np.ndarray
    accepted: Samples
    errors: dict[str, Errors]

    @classmethod
    def of(cls, task: Task, fits: Fits) -> _Scored:
        """Of fits to the training set of a task."""
        samples, sets, final = task.samples, task.sets, fits.final
        wrong = rejected(final, samples, sets.train, task.cell.distances)
        alone, own = (errors(fit.model, samples).position_norm for fit in (fits.geometric, final))
        wrong &= ~(_TIMES * alone < own)  # geometry alone fits them: it is the effects that miss them
        if wrong[sets.held_out].all():  # then it is the model that misses them
            wrong[sets.held_out] = False
        accepted = task.held_out.select(~wrong[sets.held_out])
        bare = {"nominal": fits.nominal.model, "geometric": fits.geometric.model}
        bare = {stage: model.with_effects(_stated(model, task)) for stage, model in bare.items()}
        used = as_used(final, fits.geometric, task.train, accepted, task.cell.distances)
        return cls(wrong, accepted, {s: errors(m, accepted) for s, m in {**bare, "final": used}.items()})


def supported(task: Task, fits: Fits) -> Fits:
    """The fits, without effects where these are worse than geometry alone on the samples that choose.

    All of these count but those that both reject: one that only effects miss is a test of them.
    """
    final, alone, chose = fits.final, fits.geometric, task.sets.explain
    wrong = [rejected(fit, task.samples, task.sets.train, task.cell.distances)[chose] for fit in (alone, final)]
    counted = task.explain.select(~np.all(wrong, axis=0))
    used = as_used(final, alone, task.train, counted, task.cell.distances)
    left = [squared_residuals(errors(model, counted), counted, alone.noise) for model in (used, alone.model)]
    stated = replace(fits.diagnosis, fit=alone, causes=fits.diagnosis.causes[: len(alone.model.effects)])
    return fits if left[0].sum() <= left[1].sum() else replace(fits, final=alone, diagnosis=stated, together=False)


def scored(task: Task, fits: Fits, drawn: Task, seen_by: Fits) -> tuple[Outcome, Calibration]:
    """The outcome and the calibration to ship.

    fits: to the samples' own split: what is named, shipped and said of the model is theirs. drawn, seen_by: the split
    that was drawn for the score, and fits to that; the same objects where both splits are the same.
    """
    samples, cell, final = task.samples, task.cell, fits.final
    own = _Scored.of(task, fits)
    seen = own if drawn is task else _Scored.of(drawn, seen_by)
    wrong = own.wrong
    shipped, claim, again, carried = _shipped(task, fits, wrong)
    taken_in = readmitted(shipped.calibrated, samples, again, wrong)
    distances = distances_of(final, task.train, cell.distances)
    grounds = _grounds(task, fits, seen, wrong, distances)
    grounds = replace(grounds, not_applied=carried.not_applied, converged=grounds.converged and shipped.converged)
    case = fitted_case(final, samples, task.sets, wrong, own.errors, cell.distances)
    parts = contributions_of(case)
    counted = tuple(p for p in parts if not _is_stated((final.model.effects[p.numbers[0]],), task))
    asked = case if drawn is task else replace(case, held_out=_kept(drawn, seen), errors=seen.errors)
    judged = with_places(judge(asked, grounds, cell.stated, counted), asked, described=task.chain)
    found = (
        *findings(replace(fits.diagnosis, fit=final), shipped.calibrated, case, judged, parts),
        *load_findings(fits.loads, final.model, own.accepted),
    )
    stated = tuple(finding for finding in found if _is_stated(finding.effects, task))
    found = tuple(finding for finding in found if finding not in stated)
    proved = tuple(finding for finding in found if finding.shown)
    unproved = tuple(finding for finding in found if finding not in proved)
    outcome = Outcome(
        samples=samples,
        sets=drawn.sets,
        scored=seen.accepted,
        rejected=int(seen.wrong.sum()),
        errors=seen.errors,
        effects=proved,
        unproved=unproved,
        left=(fits.diagnosis.left or located(final, samples)) if judged.may_depend else None,
        identifiability=identifiability(final),
        parameters=shipped.parameters,
        offsets=offsets_of(shipped),
        left_out=fits.chosen.left_out,
        notes=(
            *stated_note(stated),
            *description_note(errors(fits.nominal.model, own.accepted), task.chain),
            *instrument_notes(final),
            *one_instrument_notes(final),
            *load_notes(fits.loads),
            *unproved_note(unproved),
            *readmitted_note(taken_in),
            *residual_notes(case, parts),
            *carried.notes,
            *not_asked_note(judged),
        ),
        readmitted=taken_in,
        steps=_steps(drawn, seen_by, seen),
        evidence=fits.diagnosis.maps,
        model=final.model,
        residuals=case.residuals.position_norm,
        wrong=seen.wrong,
        rejection=rejection(errors(seen_by.final.model, drawn.held_out), seen.wrong, samples, drawn.sets.held_out),
        distances=distances,
        grounds=grounds,
        judged=judged,
        loads=fits.loads,
        claim=claim,
    )
    return outcome, shipped


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


def _kept(task: Task, seen: _Scored) -> np.ndarray:
    """Rows of the held-out samples that were not rejected."""
    return task.sets.held_out[~seen.wrong[task.sets.held_out]]


def _steps(task: Task, fits: Fits, seen: _Scored) -> tuple[Step, ...]:
    """What each thing that was added leaves of the accepted samples, the moves that were stated in all of them."""
    left, accepted = seen.errors, seen.accepted
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


def _grounds(task: Task, fits: Fits, seen: _Scored, wrong: np.ndarray, distances: tuple[KnownDistance, ...]) -> Grounds:
    """What the verdict stands on beside the errors."""
    samples, cell, chain, final = task.samples, task.cell, task.chain, fits.final
    small = too_small(seen.errors, seen.accepted, samples, chain, cell.stated)
    against = contradictions(final, task.train, samples, seen.accepted, wrong, seen.errors, distances, cell, chain)
    return Grounds(
        converged=all(fit.converged for fit in (fits.nominal, fits.geometric, final)),
        regimes=regimes_of(final.model, samples),
        contradictions=(*small.contradictions, *against, *task.absurd),
        unproven=small.unproven,
        not_asked=small.not_asked,
        convention=task.convention,
        rejected_runs=runs_of(samples, wrong),
        rejected_places=places_of(samples, wrong),
    )

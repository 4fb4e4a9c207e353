"""What a calibration has to fit and its score on what no fit has seen: samples in one convention, cut into three sets;
the model to ship, fitted to all of them, and the verdict.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from modcal_core.calibration import (
    SHARES,
    Calibration,
    Cell,
    Errors,
    Fit,
    KnownDistance,
    Model,
    ParameterChoice,
    Split,
    as_used,
    distances_of,
    enough_for_effects,
    errors,
    finalise,
    identifiability,
    parameter_count,
    places_of,
    readmitted,
    rejected,
    require_enough,
    right_after_all,
    runs_of,
    split,
    squared_residuals,
    uncertainty,
    with_sockets,
    without,
)
from modcal_core.claim import Claim, claim_at_tool, settled
from modcal_core.diagnosis import Diagnosis, Loads, located, with_stated
from modcal_core.effects import Effect
from modcal_core.hypotheses import proved
from modcal_core.measurements import Samples
from modcal_core.moves import find_regimes, moves_of
from modcal_core.outcome import (
    Outcome,
    Step,
    finding_notes,
    findings,
    fit_notes,
    load_findings,
    load_notes,
    not_asked_note,
    offsets_of,
    readmitted_note,
    residual_notes,
)
from modcal_core.robots import Inertias, Mechanism, weightless
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
    sane_inertias,
    too_small,
    with_places,
)


@dataclass(frozen=True)
class Task:
    """Samples of an arm and the split of them. regimes: a model to begin from, with base and tool where they stood.

    convention: what was undone in the readings. absurd: sentences on inertias that no arm has.
    """

    chain: Mechanism
    samples: Samples
    sets: Split
    cell: Cell
    inertias: Inertias | None
    regimes: Model | None
    convention: str | None
    absurd: tuple[str, ...]

    @cached_property
    def train(self) -> Samples:
        """The samples that fit the model."""
        return self.samples.select(self.sets.train)

    @cached_property
    def explain(self) -> Samples:
        """The samples that choose what is added to it; none where all others are needed for the geometry."""
        return self.samples.select(self.sets.explain)

    @cached_property
    def held_out(self) -> Samples:
        """The samples that score it."""
        return self.samples.select(self.sets.held_out)


@dataclass(frozen=True)
class Fits:
    """Fits to the training set. chosen: parameters of the geometry. together: whether small curves came last."""

    nominal: Fit
    geometric: Fit
    final: Fit
    chosen: ParameterChoice
    diagnosis: Diagnosis
    loads: Loads | None = None
    together: bool = False


def tasks_of(
    samples: Samples,
    chain: Mechanism,
    rng: np.random.Generator,
    cell: Cell,
    inertias: Inertias | None,
    block: int | None,
) -> tuple[Task, Task]:
    """The task of what is named and shipped, whose split is the samples' own, and that of the score, whose split is
    drawn; they are one object where both splits are the same.

    Arguments are those of :func:`modcal_core.loop.calibrate`. Raises ModcalError for too few samples, or readings in a
    convention that cannot be undone.
    """
    cell.require_frames(samples.frames)
    cell = cell.met(samples)
    samples = with_sockets(samples, cell, chain)
    count = parameter_count(chain, samples, cell.kept, cell.distances)
    require_enough(samples, count, len(cell.distances), share=SHARES[0] + SHARES[1])
    samples, convention = proved(samples, chain)
    inertias, absurd = sane_inertias(inertias, chain)
    if cell.gravity is not None:
        inertias = (inertias or weightless(chain.n)).pulled(cell.gravity)
    samples = with_stated(samples, cell, inertias is not None and inertias.known)
    regimes = find_regimes(samples, chain, cell, inertias, cell.moved)
    moves = moves_of(regimes) if regimes else ()
    both = []
    for draw in (np.random.default_rng(0), rng):
        sets = split(samples, draw, block, [move.at for move in moves])
        if not enough_for_effects(samples.select(sets.train), count, len(cell.distances)):
            sets = replace(sets, train=np.union1d(sets.train, sets.explain), explain=sets.explain[:0])
        both.append(Task(chain, samples, sets, cell, inertias, regimes, convention, absurd))
    own, drawn = both
    return own, own if np.array_equal(own.sets.role, drawn.sets.role) else drawn


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
        errors=seen.errors,
        effects=proved,
        unproved=unproved,
        left=(fits.diagnosis.left or located(final, samples)) if judged.may_depend else None,
        identifiability=identifiability(final),
        parameters=shipped.parameters,
        offsets=offsets_of(shipped),
        left_out=fits.chosen.left_out,
        notes=(
            *finding_notes(stated, unproved),
            *fit_notes(fits.nominal, final, own.accepted),
            *load_notes(fits.loads),
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
    left, accepted, found = seen.errors, seen.accepted, fits.diagnosis
    fit, stated = found.fit, [task.cell.states(cause.effect, task.samples.stamps) for cause in found.causes]
    known = uncertainty(fit.model, task.train, fit.parameters, fit, task.cell.distances) if found.causes else None
    added = []
    for i, cause in enumerate(found.causes):
        if known is not None and not stated[i]:
            later = [j for j in range(i + 1, len(stated)) if not stated[j]]
            added.append(Step(cause.effect.label, errors(without(fit.model, known, later), accepted)))
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

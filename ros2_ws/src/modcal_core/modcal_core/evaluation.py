"""The other path: a frozen calibration at another recording, and how far it misses there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modcal_core.calibration import (
    Calibration,
    Cell,
    errors,
    hold_out_all,
    outlying,
    places_of,
    refit_cell,
    runs_of,
    split,
    with_doubt,
    with_frames,
    with_sockets,
)
from modcal_core.claim import claim_at_tool
from modcal_core.diagnosis import frozen, located
from modcal_core.hypotheses import computed_in_part, proved
from modcal_core.measurements import Samples
from modcal_core.outcome import Outcome, Step, moved_note, not_asked_note, offsets_of, unseen_note
from modcal_core.verdict import (
    Grounds,
    applicable,
    doubtful,
    frozen_case,
    judge,
    own_rows,
    own_uncertainty,
    rejection,
    too_many,
    too_small,
    with_places,
)

MAX_OUTSIDE = 0.05  # share of the samples outside the joint ranges that were calibrated; more make a verdict doubt


def evaluate(
    calibration: Calibration,
    samples: Samples,
    rng: np.random.Generator,
    refit_base: bool = False,
    refit_tool: bool = False,
    cell: Cell | None = None,
    block: int | None = None,
) -> Outcome:
    """How far a frozen calibration misses on another recording.

    Where base or tool have changed since, they are found again, for the nominal arm too: on a part of the recording,
    and the score is that of the rest. Otherwise every sample is scored.

    Readings are judged by the spread that the calibration has of itself. Where more of them lie outside than single
    wrong readings make up, it is the model that is wrong, and none is left out of the score.
    """
    cell = (cell or Cell()).met(samples)
    samples = with_sockets(samples, cell, calibration.nominal.chain)
    samples, convention = proved(samples, calibration.nominal.chain)
    again, converged = None, True
    applied = applicable(calibration, samples)
    models = {"nominal": calibration.nominal, "geometric": calibration.geometric, "final": applied.model}
    if refit_base or refit_tool:
        sets = split(samples, rng, block)
        train = samples.select(np.union1d(sets.train, sets.explain))
        fits = {stage: refit_cell(model, train, cell, refit_base, refit_tool) for stage, model in models.items()}
        models = {stage: fit.model for stage, fit in fits.items()}
        again, converged = fits["final"], all(fit.converged for fit in fits.values())
    else:
        sets = hold_out_all(samples)
        models = {stage: with_frames(model, samples.frames) for stage, model in models.items()}
    beyond = calibration.fallback(models["final"], models["geometric"])
    models["final"] = replace(models["final"], fallback=beyond)
    held_out = samples.select(sets.held_out)
    wrong = np.zeros(len(samples), bool)
    final, every = models["final"], np.arange(len(held_out))
    spread = with_doubt(calibration.with_scatter(held_out), final, own_uncertainty(calibration, final), every)
    wrong[sets.held_out] = outlying(final, calibration.noise, spread)
    single = not too_many(wrong[sets.held_out], held_out)
    rows = sets.held_out[~wrong[sets.held_out]] if single else sets.held_out
    scored = samples.select(rows)
    residuals = {stage: errors(model, scored) for stage, model in models.items()}
    small = too_small(residuals, scored, samples, calibration.nominal.chain, cell.stated)
    own = own_rows(samples, calibration)
    grounds = Grounds(
        converged=converged,
        not_applied=applied.not_applied,
        contradictions=(
            *own.contradictions,
            *small.contradictions,
            *doubtful(residuals, scored, samples, calibration.nominal.chain),
            *computed_in_part(samples, calibration.nominal.chain, wrong),
            *samples.origin.doubts,
        ),
        convention=convention,
        rejected_runs=runs_of(samples, wrong),
        rejected_places=places_of(samples, wrong),
        unproven=(*own.unproven, *small.unproven),
        not_asked=small.not_asked,
        outside=(*unseen_note(scored, calibration, MAX_OUTSIDE), *applied.notes),
    )
    accepted = samples.select(~wrong) if single else samples
    stood = replace(calibration, nominal=models["nominal"], calibrated=models["final"])
    claim = claim_at_tool(stood, accepted, cell, frozen="arm" if refit_base or refit_tool else "whole")
    case = frozen_case(calibration, models["final"], samples, sets.unit, rows, wrong, residuals, refit_base, refit_tool)
    judged = with_places(judge(case, grounds, cell.stated), case, grounds.outside)
    return Outcome(
        samples=samples,
        sets=sets,
        scored=scored,
        rejected=len(held_out) - len(scored),
        errors=residuals,
        parameters=calibration.parameters,
        offsets=offsets_of(calibration),
        notes=(
            *moved_note(residuals["final"], calibration, refit_base, refit_tool),
            *unseen_note(scored, calibration),
            *applied.notes,
            *not_asked_note(judged),
        ),
        steps=(
            Step("geometry", residuals["geometric"]),
            *([Step("all effects", residuals["final"])] if calibration.calibrated.effects else []),
        ),
        model=models["final"],
        residuals=errors(models["final"], samples).position_norm,
        wrong=wrong,
        rejection=rejection(errors(models["final"], held_out), wrong, samples, sets.held_out, frozen=True),
        grounds=grounds,
        judged=judged,
        claim=claim,
        left=located(frozen(models["final"], calibration.noise, again), samples) if judged.may_depend else None,
    )

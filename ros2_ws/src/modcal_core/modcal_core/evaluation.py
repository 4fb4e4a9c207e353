"""The other path: a frozen calibration at another recording, and how far it misses there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from modcal_core.calibration import (
    Calibration,
    Cell,
    Fit,
    Model,
    Split,
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
    Applied,
    Grounds,
    applicable,
    doubtful,
    frozen_case,
    judge,
    on_joints_clock,
    own_rows,
    own_uncertainty,
    rejection,
    too_many,
    too_small,
    with_places,
)

MAX_OUTSIDE = 0.05  # share of the samples outside the joint ranges that were calibrated; more make a verdict doubt


@dataclass(frozen=True)
class _Stood:
    """The frozen models at a recording: nominal, geometric and final, by name. sets: where base or tool were found
    again, and what is scored. again: that fit of the final one; None where all stands as it was.
    """

    models: dict[str, Model]
    sets: Split
    applied: Applied
    again: Fit | None = None
    converged: bool = True

    @property
    def final(self) -> Model:
        """The calibrated model."""
        return self.models["final"]


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
    recorded, (samples, late) = samples, on_joints_clock(calibration, samples)
    stood = _stood(calibration, samples, cell, (refit_base, refit_tool), partial(split, samples, rng, block))
    final, held_out = stood.final, samples.select(stood.sets.held_out)
    wrong = np.zeros(len(samples), bool)
    known, every = own_uncertainty(calibration, final), np.arange(len(held_out))
    spread = with_doubt(calibration.with_scatter(held_out), final, known, every)
    wrong[stood.sets.held_out] = outlying(final, calibration.noise, spread)
    single = not too_many(wrong[stood.sets.held_out], held_out)
    rows = stood.sets.held_out[~wrong[stood.sets.held_out]] if single else stood.sets.held_out
    scored = samples.select(rows)
    residuals = {stage: errors(model, scored) for stage, model in stood.models.items()}
    grounds = replace(_grounds(calibration, stood, recorded, wrong, scored, cell), convention=convention)
    accepted = samples.select(~wrong) if single else samples
    placed = replace(calibration, nominal=stood.models["nominal"], calibrated=final)
    claim = claim_at_tool(placed, accepted, cell, frozen="arm" if refit_base or refit_tool else "whole")
    case = frozen_case(calibration, final, samples, stood.sets.unit, rows, wrong, residuals, refit_base, refit_tool)
    judged = with_places(judge(case, grounds, cell.stated), case, grounds.outside)
    steps = [Step("geometry", residuals["geometric"])]
    if calibration.calibrated.effects:
        steps.append(Step("all effects", residuals["final"]))
    return Outcome(
        samples=samples,
        sets=stood.sets,
        scored=scored,
        errors=residuals,
        parameters=calibration.parameters,
        offsets=offsets_of(calibration),
        notes=(
            *late,
            *moved_note(residuals["final"], calibration, refit_base, refit_tool),
            *unseen_note(scored, calibration),
            *stood.applied.notes,
            *not_asked_note(judged),
        ),
        steps=tuple(steps),
        model=final,
        residuals=errors(final, samples).position_norm,
        wrong=wrong,
        rejection=rejection(errors(final, held_out), wrong, samples, stood.sets.held_out, frozen=True),
        grounds=grounds,
        judged=judged,
        claim=claim,
        left=located(frozen(final, calibration.noise, stood.again), samples) if judged.may_depend else None,
    )


def _stood(
    calibration: Calibration, samples: Samples, cell: Cell, refit: tuple[bool, bool], cut: Callable[[], Split]
) -> _Stood:
    """The models as they stand, or with base and tool found again. refit: base, tool. cut: the split, where it is
    needed.
    """
    applied = applicable(calibration, samples)
    models = {"nominal": calibration.nominal, "geometric": calibration.geometric, "final": applied.model}
    if any(refit):
        sets = cut()
        train = samples.select(np.union1d(sets.train, sets.explain))
        fits = {stage: refit_cell(model, train, cell, *refit) for stage, model in models.items()}
        models = {stage: fit.model for stage, fit in fits.items()}
        again, converged = fits["final"], all(fit.converged for fit in fits.values())
    else:
        models = {stage: with_frames(model, samples.frames) for stage, model in models.items()}
        sets, again, converged = hold_out_all(samples), None, True
    beyond = calibration.fallback(models["final"], models["geometric"])
    models["final"] = replace(models["final"], fallback=beyond)
    return _Stood(models, sets, applied, again, converged)


def _grounds(
    calibration: Calibration, stood: _Stood, samples: Samples, wrong: np.ndarray, scored: Samples, cell: Cell
) -> Grounds:
    """What the verdict stands on beside the errors."""
    chain = calibration.nominal.chain
    residuals = {stage: errors(model, scored) for stage, model in stood.models.items()}
    small, own = too_small(residuals, scored, samples, chain, cell.stated), own_rows(samples, calibration)
    return Grounds(
        converged=stood.converged,
        not_applied=stood.applied.not_applied,
        contradictions=(
            *own.contradictions,
            *small.contradictions,
            *doubtful(residuals, scored, samples, chain),
            *computed_in_part(samples, chain, wrong),
            *samples.origin.doubts,
        ),
        rejected_runs=runs_of(samples, wrong),
        rejected_places=places_of(samples, wrong),
        unproven=(*own.unproven, *small.unproven),
        not_asked=small.not_asked,
        outside=(*unseen_note(scored, calibration, MAX_OUTSIDE), *stood.applied.notes),
    )

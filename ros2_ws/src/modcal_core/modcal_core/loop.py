"""The main path: samples in, a better model and an honest report out.

*Train* fits the model, *explain* chooses what to add to it, *held-out* scores it, once. What is shipped is the same
model fitted once more to every accepted sample; what is reported is the score of the one that had not seen the held-out
set.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from modcal_core.calibration import (
    SHARES,
    Calibration,
    Cell,
    Fit,
    choose_parameters,
    distances_of,
    errors,
    finalise,
    fit_cell,
    free_cell,
    identifiability,
    parameter_count,
    places_of,
    readmitted,
    rejected,
    require_enough,
    right_after_all,
    runs_of,
    sharpened,
    split,
    views_of,
    with_sockets,
)
from modcal_core.claim import claim_at_tool, fit_held
from modcal_core.diagnosis import (
    Diagnosis,
    Loads,
    causes_of_moves,
    diagnose,
    located,
    stated_arm,
    weighed,
    with_arm,
    with_residual_curves,
    with_stated,
)
from modcal_core.effects import remembered
from modcal_core.effects.families import payload
from modcal_core.hypotheses import proved, require_plausible
from modcal_core.measurements import Samples
from modcal_core.regimes import find_regimes, moves_of
from modcal_core.report import (
    Report,
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
)
from modcal_core.robots import Inertias, Mechanism, weightless
from modcal_core.verdict import (
    TOGETHER,
    Grounds,
    carried_over,
    contradictions,
    fitted_case,
    judge,
    regimes_of,
    rejection,
    sane_inertias,
    too_small,
    with_places,
)


@dataclass(frozen=True)
class Solution:
    """A report, the calibration to ship, and the fit that was scored."""

    report: Report
    calibration: Calibration
    scored: Fit


@remembered()
def calibrate(
    samples: Samples,
    chain: Mechanism,
    rng: np.random.Generator,
    cell: Cell | None = None,
    block: int | None = None,
    inertias: Inertias | None = None,
    progress: Callable[[str], None] = lambda _: None,
    look_for_effects: bool = True,
    changed: float | None = None,
) -> Solution:
    """The calibration of this arm from these samples, scored on samples that it has not seen.

    cell: what is known of the surroundings and what must stay as it is. block: stations that the split keeps together;
    None decides. inertias: of the arm's bodies, for effects of load. progress: called with each effect that is tried.
    look_for_effects: go beyond geometry. changed: stamp [s] about which something is known to have happened.
    Raises ModcalError for data that cannot carry a fit.
    """
    # what was measured, in one convention, base and tool where they stood
    cell = cell or Cell()
    cell.require_frames(samples.frames)
    cell = cell.met(samples)
    samples = with_sockets(samples, cell, chain)
    count = parameter_count(chain, samples, cell.kept, cell.distances)
    require_enough(samples, count, len(cell.distances), share=SHARES[0])
    samples, convention = proved(samples, chain)
    inertias, absurd = sane_inertias(inertias, chain)
    if cell.gravity is not None:
        inertias = (inertias or weightless(chain.n)).pulled(cell.gravity)
    samples = with_stated(samples, cell, inertias is not None and inertias.known)
    regimes = find_regimes(samples, chain, cell, inertias, cell.moved)
    moves = moves_of(regimes) if regimes else ()
    sets = split(samples, rng, block, [move.at for move in moves])
    train, explain, held_out = (samples.select(rows) for rows in (sets.train, sets.explain, sets.held_out))

    # the drawing, then the geometry
    nominal = fit_cell(chain, train, cell, inertias, regimes)
    choice = choose_parameters(nominal.model, views_of(samples), cell.kept, cell.distances)
    choice = replace(choice, parameters=free_cell(choice.parameters, cell))
    geometric = fit_held(nominal.model, train, choice.parameters, cell)
    choice = replace(choice, parameters=geometric.parameters)
    if geometric.model.arm is not None:
        geometric = with_arm(geometric, stated_arm(geometric.model.arm, cell))
    if not samples.moving.any():  # in motion, a late tracker alone misses by centimetres, and is found below
        require_plausible(nominal, geometric, train, samples, cell.distances, bool(cell.known))

    # what is left: where it comes from, an effect for it, and again
    diagnosis = Diagnosis(geometric, causes_of_moves(geometric, samples), None)
    loads: Loads | None = None
    if look_for_effects:
        suspects = (lambda at: ()) if changed is None else partial(payload.since, time=changed)
        known = diagnosis.causes

        def search(fit: Fit) -> Diagnosis:
            return diagnose(fit, train, explain, rng, cell.distances, progress, suspects, known)

        diagnosis, loads = weighed(geometric, train, explain, search, cell)
        if loads is not None:
            geometric = with_arm(geometric, loads.arm)
    # when something moved is read from all stations: one next to it that was held out belongs to either side
    last = diagnosis.fit
    if look_for_effects:
        last = with_residual_curves(last, train, explain, rng, cell.distances, block)
    final = replace(last, model=sharpened(last.model, samples))
    require_plausible(nominal, final, train, samples, cell.distances, bool(cell.known))

    # the score on what no fit has seen, and the model to ship, fitted to all of it
    wrong = rejected(final, samples, sets.train, cell.distances)
    if wrong[sets.held_out].all():  # then it is the model that misses them
        wrong[sets.held_out] = False
    scored = held_out.select(~wrong[sets.held_out])
    again, whole = right_after_all(final, samples, choice.parameters, cell.distances, wrong)
    shipped = finalise(samples, chain, choice, cell, inertias, final, wrong & ~again, regimes, geometric, whole)
    if diagnosis.again is not None:
        again[sets.train] |= diagnosis.again
    kept = samples.select(~wrong | again)
    carried = carried_over(shipped, kept)
    claim = claim_at_tool(shipped, kept, cell, carried=carried.model if carried.not_applied else None)
    shipped = replace(shipped, uncertainty=claim.known or shipped.uncertainty, claim_mm=claim.mm["p95"].ci95[1])
    taken_in = readmitted(shipped.calibrated, samples, again, wrong)
    distances = distances_of(final, train, cell.distances)
    shipped = replace(shipped, rivals=tuple(cause.rivals for cause in diagnosis.causes))
    left = {
        "nominal": errors(nominal.model.with_effects(()), scored),
        "geometric": errors(geometric.model.with_effects(()), scored),
        "final": errors(final.model, scored),
    }
    added = [Step(cause.effect.label, errors(cause.fit.model, scored)) for cause in diagnosis.causes]
    if added and last is diagnosis.fit:
        added[-1] = replace(added[-1], errors=left["final"])  # what the final model leaves, its moments sharpened
    steps = (Step("geometry", left["geometric"]), *added)
    if last is not diagnosis.fit:
        steps = (*steps, Step(TOGETHER, left["final"]))

    # the verdict
    small = too_small(left, scored, samples, chain, cell.stated)
    grounds = Grounds(
        converged=all(fit.converged for fit in (nominal, geometric, final)) and shipped.converged,
        regimes=regimes_of(final.model, samples),
        not_applied=carried.not_applied,
        contradictions=(
            *small.contradictions,
            *contradictions(final, train, samples, scored, wrong, left, distances, cell, chain),
            *absurd,
        ),
        unproven=small.unproven,
        not_asked=small.not_asked,
        convention=convention,
        rejected_runs=runs_of(samples, wrong),
        rejected_places=places_of(samples, wrong),
    )
    case = fitted_case(final, samples, sets, wrong, left, cell.distances)
    judged = with_places(judge(case, grounds, cell.stated), case, described=chain)
    report = Report(
        samples=samples,
        sets=sets,
        scored=scored,
        rejected=int(wrong.sum()),
        errors=left,
        effects=(
            *findings(replace(diagnosis, fit=final), shipped.calibrated, case),
            *load_findings(loads, final.model, scored),
        ),
        left=diagnosis.left or (located(final, samples) if judged.status == "open" else None),
        identifiability=identifiability(final),
        parameters=shipped.parameters,
        offsets=offsets_of(shipped),
        left_out=choice.left_out,
        notes=(
            *description_note(left["nominal"], chain),
            *instrument_notes(final),
            *load_notes(loads),
            *readmitted_note(taken_in),
            *residual_notes(case),
            *carried.notes,
            *not_asked_note(judged),
        ),
        readmitted=taken_in,
        steps=steps,
        evidence=diagnosis.maps,
        model=final.model,
        residuals=case.residuals.position_norm,
        wrong=wrong,
        searched=look_for_effects,
        rejection=rejection(errors(final.model, held_out), wrong, samples, sets.held_out),
        distances=distances,
        grounds=grounds,
        judged=judged,
        loads=loads,
        claim=claim,
    )
    return Solution(report, shipped, final)

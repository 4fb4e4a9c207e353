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

from modcal_core.calibration.cell import Cell, fit_cell, refit_cell, with_frames
from modcal_core.calibration.conventions import proved
from modcal_core.calibration.distances_together import contradicted_together
from modcal_core.calibration.doubts import LIMIT_OF_REACH, require_plausible
from modcal_core.calibration.gauge import least_change
from modcal_core.calibration.identifiability import identifiability
from modcal_core.calibration.identify import FITTED, Fit, identify, require_enough
from modcal_core.calibration.known_distances import contradictions as contradictions_of_distances
from modcal_core.calibration.known_distances import distances_of
from modcal_core.calibration.model import Model
from modcal_core.calibration.moments import sharpened
from modcal_core.calibration.moves import identify_moved
from modcal_core.calibration.regimes import find_regimes, moves_of
from modcal_core.calibration.runs import runs_of
from modcal_core.calibration.score import Errors, errors, outlying, usual_scatter
from modcal_core.calibration.sockets import with_sockets
from modcal_core.calibration.split import SHARES, hold_out_all, split
from modcal_core.calibration.store import Calibration, parameter_table
from modcal_core.calibration.structure import Choice, choose_parameters, parameter_count, views_of
from modcal_core.calibration.uncertainty import uncertainty
from modcal_core.calibration.usual import driver_ranges, usual_sizes
from modcal_core.diagnosis.locate import frozen, located
from modcal_core.diagnosis.loop import Diagnosis, causes_of_moves, diagnose
from modcal_core.diagnosis.vocabulary import load_since
from modcal_core.measurements.kinds.registry import kinds
from modcal_core.measurements.samples import Samples
from modcal_core.report.findings import findings
from modcal_core.report.report import Report, Step
from modcal_core.robots.mechanism import Mechanism
from modcal_core.robots.urdf_inertias import Inertias
from modcal_core.verdict.absurd import long_tool, sane_inertias
from modcal_core.verdict.case import fitted_case, frozen_case
from modcal_core.verdict.grounds import Grounds
from modcal_core.verdict.not_applied import applicable
from modcal_core.verdict.readings import doubtful
from modcal_core.verdict.regimes import regimes_of
from modcal_core.verdict.rejection import MOST_SINGLE, rejection
from modcal_core.verdict.status import judge
from modcal_core.verdict.where import with_places

MOST_OUTSIDE = 0.05  # share of the samples outside the joint ranges that were calibrated; more make a verdict doubt
_MOST_KEPT = 200  # postures that a calibration remembers


@dataclass(frozen=True)
class Result:
    """A report, the calibration to ship, and the fit that was scored."""

    report: Report
    calibration: Calibration
    scored: Fit


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
) -> Result:
    """The calibration of this arm from these samples, scored on samples that it has not seen.

    cell: what is known of the surroundings and what must stay as it is. block: stations that the split keeps together;
    None decides. inertias: of the arm's bodies, for effects of load. progress: hears of each effect that is tried.
    look_for_effects: go beyond geometry. changed: stamp [s] about which something is known to have happened.
    Raises ModcalError for data that cannot carry a fit.
    """
    cell = cell or Cell()
    cell.require_frames(samples.frames)
    cell = cell.met(samples)
    samples = with_sockets(samples, cell, chain)
    count = parameter_count(chain, samples, cell.kept, cell.distances)
    require_enough(samples, count, len(cell.distances), share=SHARES[0])
    samples, convention = proved(samples, chain)
    inertias, absurd = sane_inertias(inertias, chain)
    regimes = find_regimes(samples, chain, cell, inertias, cell.moved)
    moves = moves_of(regimes) if regimes else ()
    sets = split(samples, rng, block, [move.at for move in moves])
    train, explain, held_out = (samples.select(rows) for rows in (sets.train, sets.explain, sets.held_out))

    nominal = fit_cell(chain, train, cell, inertias, regimes)
    choice = choose_parameters(nominal.model, views_of(samples), cell.kept, cell.distances)
    geometric = identify_moved(nominal.model, train, choice.parameters, cell.distances)
    if not samples.moving.any():  # in motion, a late tracker alone misses by centimetres, and is found below
        require_plausible(nominal, geometric, train)
    diagnosis = Diagnosis(geometric, causes_of_moves(geometric, samples), None)
    if look_for_effects:
        suspects = (lambda at: ()) if changed is None else partial(load_since, moment=changed)
        diagnosis = diagnose(geometric, train, explain, rng, cell.distances, progress, suspects, diagnosis.causes)
    # when something moved is read from all stations: one next to it that was held out belongs to either side
    final = replace(diagnosis.fit, model=sharpened(diagnosis.fit.model, samples))
    require_plausible(nominal, final, train)

    wrong = outlying(final.model, final.spread, samples)
    scored = held_out.select(~wrong[sets.held_out])
    shipped = ship(samples, chain, choice, cell, inertias, final, wrong, regimes)
    distances = distances_of(final, train, cell.distances)
    shipped = replace(shipped, rivals=tuple(cause.rivals for cause in diagnosis.causes))
    left = {
        "nominal": errors(nominal.model.with_effects(()), scored),
        "geometric": errors(geometric.model.with_effects(()), scored),
        "final": errors(final.model, scored),
    }
    added = [Step(cause.effect.label, errors(cause.fit.model, scored)) for cause in diagnosis.causes]
    if added:
        added[-1] = replace(added[-1], errors=left["final"])  # what the final model leaves, its moments sharpened
    steps = (Step("geometry", left["geometric"]), *added)
    grounds = Grounds(
        converged=all(fit.converged for fit in (nominal, geometric, final)) and shipped.converged,
        regimes=regimes_of(final.model, samples),
        contradictions=(
            *contradictions_of_distances(distances),
            *contradicted_together(final, train, cell.distances),
            *doubtful(left, scored, samples, chain),
            *absurd,
            *long_tool(final.model),
        ),
        convention=convention,
        rejected_runs=runs_of(samples, wrong),
    )
    case = fitted_case(final, samples, sets, wrong, left, cell.distances)
    judged = with_places(judge(case, grounds, cell.stated), case)
    report = Report(
        samples=samples,
        sets=sets,
        scored=scored,
        rejected=int(wrong.sum()),
        errors=left,
        effects=findings(
            replace(diagnosis, fit=final), shipped.calibrated, samples, wrong, train, scored, cell.distances
        ),
        left=diagnosis.left or (located(final, samples) if judged.status == "open" else None),
        identifiability=identifiability(final),
        parameters=shipped.parameters,
        left_out=choice.left_out,
        notes=instrument_notes(final),
        steps=steps,
        evidence=diagnosis.maps,
        model=final.model,
        missed=errors(final.model, samples).position_norm,
        wrong=wrong,
        searched=look_for_effects,
        rejection=rejection(errors(final.model, held_out), wrong, samples, sets.held_out),
        distances=distances,
        grounds=grounds,
        judged=judged,
    )
    return Result(report, shipped, final)


def ship(
    samples: Samples,
    chain: Mechanism,
    choice: Choice,
    cell: Cell,
    inertias: Inertias | None = None,
    scored: Fit | None = None,
    wrong: np.ndarray | None = None,
    regimes: Model | None = None,
) -> Calibration:
    """The calibration fitted to every accepted sample, written with the least change to the nominal arm.

    scored: the fit whose effects it has, and which it begins from. wrong: True for samples that the score rejects,
    (N,): they are left out, and no others; by default the fit decides. regimes: a model to begin from where base or
    tool moved.
    """
    decided = wrong is not None
    watched = float(samples.stamps.min()), float(samples.stamps.max())
    if wrong is not None and wrong.any():
        samples = samples.select(np.flatnonzero(~wrong))
    nominal = fit_cell(chain, samples, cell, inertias, regimes)
    fit = last = identify_moved(nominal.model, samples, choice.parameters, cell.distances, reject=not decided)
    fits = [nominal, fit]
    geometric = fit.model
    if scored is None or not scored.model.effects:
        tidy = least_change(fit.model, chain)
    else:
        start = nominal.model.with_effects(sharpened(scored.model, samples).effects)
        fitted = partial(identify, samples=samples, parameters=choice.parameters, distances=cell.distances)
        fit = fitted(start, tolerance=FITTED, begin=scored.values, reject=not decided)
        # places moved by what was passed through the joints: effects settle where they are now
        tidy = least_change(fit.model, chain)
        settled = fitted(tidy, tolerance=10.0 * FITTED, reject=not decided)
        tidy, last = least_change(settled.model, chain), settled
        fits += [fit, settled]
    seen = np.stack([samples.q.min(axis=0), samples.q.max(axis=0)])
    kind = str(samples.kind[0])
    few = samples.q[np.unique(np.linspace(0, len(samples) - 1, min(len(samples), _MOST_KEPT)).astype(int))]
    covariance = uncertainty(tidy, samples, choice.parameters, last, cell.distances)
    return Calibration(
        *(nominal.model, tidy, geometric, seen, parameter_table(fit), (), kind, few, fit.spread, covariance, watched),
        scatter=usual_scatter(samples),
        converged=all(each.converged for each in fits),
        clock=samples.clock,
        ranges=driver_ranges(tidy, samples),
        usual=usual_sizes(tidy, samples),
    )


def evaluate(
    calibration: Calibration,
    samples: Samples,
    rng: np.random.Generator,
    refit_base: bool = False,
    refit_tool: bool = False,
    cell: Cell | None = None,
    block: int | None = None,
) -> Report:
    """How far a frozen calibration misses on another recording.

    Where base or tool have changed since, they are found again, for the nominal arm too: on a part of the recording,
    and the score is that of the rest. Otherwise every sample is scored.

    Readings are judged by the spread that the calibration has of itself. Where more of them lie outside than single
    wrong readings make up, it is the model that is wrong, and none is left out of the score.
    """
    cell = (cell or Cell()).met(samples)
    samples = with_sockets(samples, cell, calibration.nominal.chain)
    samples, convention = proved(samples, calibration.nominal.chain)
    converged = True
    applied = applicable(calibration, samples)
    models = {"nominal": calibration.nominal, "geometric": calibration.geometric, "final": applied.model}
    if refit_base or refit_tool:
        sets = split(samples, rng, block)
        train = samples.select(np.union1d(sets.train, sets.explain))
        fits = {stage: refit_cell(model, train, cell, refit_base, refit_tool) for stage, model in models.items()}
        models = {stage: fit.model for stage, fit in fits.items()}
        converged = all(fit.converged for fit in fits.values())
    else:
        sets = hold_out_all(samples)
        models = {stage: with_frames(model, samples.frames) for stage, model in models.items()}
    held_out = samples.select(sets.held_out)
    wrong = np.zeros(len(samples), bool)
    wrong[sets.held_out] = outlying(models["final"], calibration.spread, calibration.with_scatter(held_out))
    single = wrong[sets.held_out].mean() <= MOST_SINGLE
    rows = sets.held_out[~wrong[sets.held_out]] if single else sets.held_out
    scored = samples.select(rows)
    missed = {stage: errors(model, scored) for stage, model in models.items()}
    grounds = Grounds(
        converged=converged,
        not_applied=applied.not_applied,
        contradictions=doubtful(missed, scored, samples, calibration.nominal.chain),
        convention=convention,
        rejected_runs=runs_of(samples, wrong),
        outside=(*unseen_note(scored, calibration, MOST_OUTSIDE), *applied.notes),
    )
    case = frozen_case(calibration, models["final"], samples, sets.unit, rows, wrong, missed, refit_base, refit_tool)
    judged = with_places(judge(case, grounds, cell.stated), case, grounds.outside)
    return Report(
        samples=samples,
        sets=sets,
        scored=scored,
        rejected=len(held_out) - len(scored),
        errors=missed,
        parameters=calibration.parameters,
        notes=(
            *moved_note(missed["final"], calibration, refit_base, refit_tool),
            *unseen_note(scored, calibration),
            *applied.notes,
        ),
        steps=(
            Step("geometry", missed["geometric"]),
            *([Step("all effects", missed["final"])] if calibration.calibrated.effects else []),
        ),
        model=models["final"],
        missed=errors(models["final"], samples).position_norm,
        wrong=wrong,
        rejection=rejection(errors(models["final"], held_out), wrong, samples, sets.held_out, frozen=True),
        grounds=grounds,
        judged=judged,
        left=located(frozen(models["final"], calibration.spread), samples) if judged.status == "open" else None,
    )


def instrument_notes(fit: Fit) -> tuple[str, ...]:
    """For each kind of reading that is no position what it cannot see, and how it scatters about the model."""
    out = []
    for name, size in fit.spread.others.items():
        kind = kinds()[name]
        said = f"{1e3 * size:.3g} mm" if kind.unit == "m" else f"{1e6 * size:.3g} µrad"
        out.append(f"Readings of kind {name} scatter about the model by {said}. {kind.blind}")
    return tuple(out)


def moved_note(missed: Errors, calibration: Calibration, refit_base: bool, refit_tool: bool) -> tuple[str, ...]:
    """A sentence for the person whose robot, tracker or tool stands elsewhere than when it was calibrated."""
    size = missed.size_mm()
    limit = LIMIT_OF_REACH * calibration.nominal.chain.reach()
    if size is None or size.rms < 1e3 * limit or (refit_base and refit_tool):
        return ()
    return (
        "The error is larger than an arm's: base or tool have changed; --refit-base and --refit-tool find them again.",
    )


def unseen_note(samples: Samples, calibration: Calibration, beyond: float = 0.0) -> tuple[str, ...]:
    """A sentence for joints that go where the calibration has never seen them, and what is done there.

    beyond: share of the samples that may do so without a word.
    """
    low, high = calibration.seen
    margin = 0.02 * (high - low)
    out = (samples.q < low - margin) | (samples.q > high + margin)
    if out.any(axis=1).mean() <= beyond:
        return ()
    worst = [
        f"{name} (seen {low[j]:.2f} … {high[j]:.2f}, here {samples.q[:, j].min():.2f} … {samples.q[:, j].max():.2f})"
        for j, name in enumerate(samples.names)
        if out[:, j].any()
    ]
    return (
        f"{int(out.any(axis=1).sum())} of {len(samples)} samples lie outside the joint ranges that were calibrated: "
        f"{', '.join(worst)}. Learned curves are not continued there.",
    )

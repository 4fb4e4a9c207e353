"""The main path: samples in, a better model and its honest score out.

*Train* fits the model, *explain* chooses what to add to it, *held-out* scores it, once. What is shipped is the same
model fitted once more to every accepted sample; what is scored is the one that had not seen the held-out set.

A draw decides which stations score, and nothing else: what is named and shipped comes from a split of the samples' own.
Where the drawn split is another, fit and choice are made once more with it, for the score alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from modcal_core.calibration import Calibration, Cell, Fit, choose_parameters, fit_cell, free_cell, sharpened, views_of
from modcal_core.claim import fit_held
from modcal_core.diagnosis import (
    Diagnosis,
    Sought,
    causes_of_moves,
    diagnose,
    stated_arm,
    weighed,
    with_arm,
    with_residual_curves,
)
from modcal_core.effects import is_of_clock
from modcal_core.effects.families import payload
from modcal_core.hypotheses import require_plausible
from modcal_core.measurements import Samples
from modcal_core.outcome import Outcome
from modcal_core.robots import Inertias, Mechanism
from modcal_core.scoring import Fits, Task, scored, supported, tasks_of


@dataclass(frozen=True)
class Solution:
    """What was found, the calibration to ship, and the fit that was scored."""

    report: Outcome
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
) -> Solution:
    """The calibration of this arm from these samples, scored on samples that it has not seen.

    cell: what is known of the surroundings and what must stay as it is. block: stations that the split keeps together;
    None decides. inertias: of the arm's bodies, for effects of load. progress: called with each effect that is tried.
    look_for_effects: go beyond geometry. changed: stamp [s] about which something is known to have happened.
    Raises ModcalError for data that cannot carry a fit.
    """
    task, drawn = tasks_of(samples, chain, rng, cell or Cell(), inertias, block)
    effects = partial(_with_effects, block=block, progress=progress, changed=changed) if look_for_effects else _on_time
    fits = _fitted(task, effects)
    seen = fits if drawn is task else _fitted(drawn, effects)
    outcome, shipped = scored(task, fits, drawn, seen)
    searched = look_for_effects and len(task.explain) > 0
    return Solution(replace(outcome, searched=searched), shipped, seen.final)


def _fitted(task: Task, effects: Callable[[Task, Fits], Fits]) -> Fits:
    """Fits to *train*. effects: adds them, chosen by *explain*."""
    fits = _geometry(task)
    if len(task.explain):
        fits = supported(task, effects(task, fits))
    # when something moved is read from all stations: one next to it that was held out belongs to either side
    fits = replace(fits, final=replace(fits.final, model=sharpened(fits.final.model, task.samples)))
    _require_plausible(task, fits.nominal, fits.final)
    return fits


def _geometry(task: Task) -> Fits:
    """Base and tool about the nominal arm, then the geometry. Raises ModcalError where the readings cannot be right."""
    cell, samples = task.cell, task.samples
    nominal = fit_cell(task.chain, task.train, cell, task.inertias, task.regimes)
    chosen = choose_parameters(nominal.model, views_of(samples), cell.kept, cell.distances)
    geometric = fit_held(nominal.model, task.train, free_cell(chosen.parameters, cell), cell)
    chosen = replace(chosen, parameters=geometric.parameters)
    if geometric.model.arm is not None:
        geometric = with_arm(geometric, stated_arm(geometric.model.arm, cell))
    if not samples.moving.any():  # in motion, a late tracker alone misses by centimetres, and is found later
        _require_plausible(task, nominal, geometric)
    diagnosis = Diagnosis(geometric, causes_of_moves(geometric, samples), None)
    return Fits(nominal, geometric, geometric, chosen, diagnosis)


def _with_effects(
    task: Task, fits: Fits, block: int | None, progress: Callable[[str], None], changed: float | None
) -> Fits:
    """What is left: where it comes from, an effect for it, and again; and small curves for what none explains."""
    suspects = (lambda at: ()) if changed is None else partial(payload.since, time=changed)
    train, explain, known = task.train, task.explain, fits.diagnosis.causes
    sought = Sought(train, explain, task.cell.distances, progress, suspects, known)
    diagnosis, loads = weighed(fits.geometric, train, explain, partial(diagnose, sought=sought), task.cell)
    geometric = fits.geometric if loads is None else with_arm(fits.geometric, loads.arm)
    final = with_residual_curves(diagnosis.fit, train, explain, task.cell.distances, block)
    together = final is not diagnosis.fit
    return replace(fits, geometric=geometric, final=final, diagnosis=diagnosis, loads=loads, together=together)


def _on_time(task: Task, fits: Fits) -> Fits:
    """Geometry alone, and in motion what the instrument's clock is late by, or drifts: in it postures are wrong."""
    if not task.train.moving.any():
        return fits
    known = fits.diagnosis.causes
    sought = Sought(task.train, task.explain, task.cell.distances, only=is_of_clock, known=known)
    diagnosis = diagnose(fits.geometric, sought)
    return replace(fits, final=diagnosis.fit, diagnosis=diagnosis)


def _require_plausible(task: Task, nominal: Fit, fitted: Fit) -> None:
    """Raises ModcalError where the readings cannot be of this arm."""
    require_plausible(nominal, fitted, task.train, task.samples, task.cell.distances, bool(task.cell.known))

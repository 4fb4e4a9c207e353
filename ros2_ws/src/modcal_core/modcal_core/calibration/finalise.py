"""What is shipped: the model fitted once more, to every accepted sample, and what is known of it."""

from __future__ import annotations

from functools import partial

import numpy as np

from modcal_core.calibration.canonical import least_change
from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.change_points import sharpened
from modcal_core.calibration.identify import FITTED, Fit, identify
from modcal_core.calibration.model import Model
from modcal_core.calibration.moves import identify_moved
from modcal_core.calibration.outermost import geometry_is_better
from modcal_core.calibration.score import errors, typical_scatter
from modcal_core.calibration.store import Calibration, parameter_table
from modcal_core.calibration.structure import ParameterChoice
from modcal_core.calibration.typical import driver_ranges, typical_sizes
from modcal_core.calibration.uncertainty import uncertainty
from modcal_core.effects.effect import is_move
from modcal_core.errors import BadRecording
from modcal_core.measurements.marks import marks_of
from modcal_core.measurements.samples import Samples
from modcal_core.measurements.thinning import spread_rows
from modcal_core.robots.mechanism import Mechanism
from modcal_core.robots.urdf_inertias import Inertias

_OFTEN, _PLACED = 12, 3  # readings of a frame: enough to judge it by, and the fewest that place it
_MAX_KEPT = 200  # postures that a calibration remembers


def finalise(
    samples: Samples,
    chain: Mechanism,
    choice: ParameterChoice,
    cell: Cell,
    inertias: Inertias | None = None,
    scored: Fit | None = None,
    wrong: np.ndarray | None = None,
    regimes: Model | None = None,
    geometry: Fit | None = None,
    whole: Fit | None = None,
) -> Calibration:
    """The calibration fitted to every accepted sample, written with the least change to the nominal arm.

    scored: the fit whose effects it has, and which it begins from. wrong: True for samples to be left out, (N,), and no
    others are; by default the fit decides. regimes: a model to begin from where base or tool moved. geometry: the fit
    of geometry alone, from whose start all fits here begin; None: from the nominal arm's. whole: the fit to just these
    samples from scored, where there is one already.
    """
    decided = wrong is not None
    watched = float(samples.stamps.min()), float(samples.stamps.max())
    if wrong is not None and wrong.any():
        _require_each_frame(samples, ~wrong)
        samples = samples.select(~wrong)
    nominal = fit_cell(chain, samples, cell, inertias, regimes)
    begun = nominal.model if geometry is None else geometry.start
    fit = last = _geometry(begun, samples, choice, cell, geometry, not decided)
    fits = [nominal, fit]
    geometric = least_change(fit.model, chain)
    if scored is None or not scored.model.effects:
        tidy = geometric
    else:
        start = begun.with_effects(sharpened(scored.model, samples).effects)
        fitted = partial(identify, samples=samples, parameters=choice.parameters, distances=cell.distances)
        if whole is not None and whole.start.chain is start.chain:
            fit = whole  # of these samples, from there
        else:
            fit = fitted(start, tolerance=FITTED, begin=scored.values, reject=not decided)
        # places moved by what was passed through the joints: effects settle where they are now
        tidy = least_change(fit.model, chain)
        settled = fitted(tidy, tolerance=10.0 * FITTED, reject=not decided)
        tidy, last = least_change(settled.model, chain), settled
        fits.append(settled)  # which goes on from where the fit before it ended
    seen = np.stack([samples.q.min(axis=0), samples.q.max(axis=0)])
    kind = str(samples.kind[0])
    few = samples.q[spread_rows(len(samples), _MAX_KEPT)]
    covariance = uncertainty(tidy, samples, choice.parameters, last, cell.distances)
    return Calibration(
        *(nominal.model, tidy, geometric, seen, parameter_table(fit), (), kind, few, fit.noise, covariance, watched),
        scatter=typical_scatter(samples),
        converged=all(each.converged for each in fits),
        clock=samples.clock,
        left_alone=_left(geometric, samples),
        geometry_outside=geometry_is_better(tidy, geometric, samples, choice.parameters, last, cell.distances),
        ranges=driver_ranges(tidy, samples),
        typical=typical_sizes(tidy, samples),
        marks=marks_of(samples),
    )


def _require_each_frame(samples: Samples, kept: np.ndarray) -> None:
    """Raises BadRecording where hardly a reading of an instrument that read often agrees with the arm."""
    for f, name in enumerate(samples.frames):
        rows = samples.frame == f
        left, of = int(np.sum(rows & kept)), int(rows.sum())
        if of >= _OFTEN and left < _PLACED:
            raise BadRecording(
                f"frame '{name}'",
                f"{of - left} of its {of} readings agree with no place of the instrument and no target on the arm that "
                "the others show",
                "see whether its axes are left-handed, its units and its quaternions, and what it looks at; or leave "
                "its topic out with --ignore",
            )


def _left(model: Model, samples: Samples) -> float:
    """RMS [m] that a model leaves of positions; 0 where readings show none, or everything is met."""
    square = errors(model, samples).position_norm ** 2
    return float(np.sqrt(np.mean(square))) if np.isfinite(square).all() else 0.0


def _geometry(start: Model, samples: Samples, choice: ParameterChoice, cell: Cell, at: Fit | None, reject: bool) -> Fit:
    """The fit of geometry alone, from where another fit of it ended."""
    if at is None or any(is_move(effect) for effect in start.effects):
        return identify_moved(start, samples, choice.parameters, cell.distances, reject=reject)
    return identify(start, samples, choice.parameters, cell.distances, begin=at.values, reject=reject)

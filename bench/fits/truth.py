"""What a fit leaves beside the truth: whether a better optimum was missed, or its values merely cost what they cost.

The truth in the fit's own values is a fit to the same stations without noise. From there the noisy train set is fitted
once more. Where that ends as the calibration did, what is left above the floor is what fitting so many values to so few
readings adds. Of models with effects the same fit shows whether the effects that were found can be the truth.
"""

from __future__ import annotations

from dataclasses import replace

import harness
import numpy as np

from modcal_core.calibration.cell import Cell, with_bases
from modcal_core.calibration.fit import Fit, identify
from modcal_core.calibration.noise import errors, squared_residuals
from modcal_core.geometry import se3
from modcal_core.loop import Solution
from modcal_core.measurements.samples import Samples

TRUE_MM = 1e-3  # RMS that a fit to exact readings may leave to count as the truth


def missed(fit: Fit, samples: Samples) -> float:
    """RMS [mm] of what a fit leaves."""
    return 1e3 * harness.rms(errors(fit.model, samples).position_norm)


def _train(done: Solution) -> np.ndarray:
    rows = done.report.sets.train
    return rows[~done.report.wrong[rows]]


def of_geometry(done: Solution, exact: Samples, cell: Cell, tool: np.ndarray) -> dict[str, float]:
    """truth_mm: RMS that the truth, base and tool with it, leaves of the held-out stations; begun_mm: that of the same
    fit begun there; less: how much its cost is less [squared deviations]. NaN where the truth is not among its values.

    exact: the samples without noise. tool: (3,) [m].
    """
    fit, train = done.scored, done.report.samples.select(_train(done))
    about = replace(fit.start, T_tip_tool=se3.transform(fit.start.T_tip_tool[:3, :3], tool))
    for start, begin in ((fit.start, fit.values), (with_bases(about, exact, cell), None)):
        true = identify(start, exact, fit.parameters, cell.distances, robust=False, begin=begin)
        if missed(true, exact) < TRUE_MM:
            break
    else:
        return dict.fromkeys(("truth_mm", "begun_mm", "less"), np.nan)
    again = identify(true.start, train, fit.parameters, cell.distances, begin=true.values)
    scored = done.report.scored
    less = _cost(fit, fit, train) - _cost(again, fit, train)
    return {"truth_mm": missed(true, scored), "begun_mm": missed(again, scored), "less": less}


def of_effects(done: Solution, exact: Samples, cell: Cell) -> dict[str, float]:
    """Ratios: over_truth: what is left over what the truth leaves of the same held-out stations; expected: the same by
    the covariance of the values; lacks: what the model that was found leaves of stations without noise, over the
    truth's; over_begun: over the same model fitted from the values that stations without noise give it.
    """
    report, fit, rows = done.report, done.scored, _train(done)
    start = fit.start.with_effects(fit.model.effects)
    true = identify(start, exact.select(rows), fit.parameters, cell.distances, robust=False, begin=fit.values)
    start = true.start.with_effects(true.model.effects)
    again = identify(start, report.samples.select(rows), fit.parameters, cell.distances, begin=true.values)
    held = report.sets.held_out[~report.wrong[report.sets.held_out]]
    noise = report.samples.reading[held] - exact.reading[held]
    left = 1e3 * float(np.sqrt(np.mean(np.sum(noise**2, axis=1))))
    estimation = {row.what: row.value for row in report.judged.account_mm2}["estimation"]
    final = missed(fit, report.scored)
    return {
        "over_truth": final / left,
        "expected": float(np.sqrt(1.0 + estimation / left**2)),
        "lacks": missed(true, exact.select(held)) / left,
        "over_begun": final / missed(again, report.scored),
    }


def _cost(fit: Fit, scale: Fit, samples: Samples) -> float:
    """Squares of what a fit leaves, and of its values in priors, in deviations of one scale for all fits."""
    prior = np.array([p.prior_std for p in fit.parameters])
    square = squared_residuals(errors(fit.model, samples), samples, scale.noise)
    return float(square.sum() + np.sum((fit.values / prior) ** 2))

"""What the same fit leaves when it is begun at the truth: whether a better optimum was missed, or values merely cost.

The truth in the fit's own values is a fit to the same stations without noise, which leaves nothing. From there the
noisy train set is fitted once more. Where that ends as the calibration did, what is left above the floor is what
fitting so many values to so few readings adds, and not a minimum that was not found. Of models with effects the same
fit also shows whether the effects that were found can be the truth: what they leave of stations without noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration.cell import Cell, with_bases
from modcal_core.calibration.identify import Fit, identify
from modcal_core.calibration.score import errors, squared_residuals
from modcal_core.geometry import se3
from modcal_core.loop import Solution
from modcal_core.measurements.samples import Samples

HEADS = "÷ truth, same stations, median | worst | expected | missing, median | worst | ÷ fit begun at the truth, worst"
TRUE_MM = 1e-3  # RMS that a fit to exact readings may leave to count as the truth


@dataclass(frozen=True)
class FromTruth:
    """RMS on held-out stations [mm] begun at the truth, by how much the cost of the train set is less from there
    [squared deviations], and the RMS [mm] of the scored truth itself, base and tool with it, on the same stations.

    known: whether the truth was found at all.
    """

    rms_mm: float
    less: float
    truth_mm: float
    known: bool


def from_truth(done: Solution, exact: Samples, cell: Cell, tool: np.ndarray) -> FromTruth:
    """What the geometry leaves when begun at the truth. exact: the samples without noise. tool: (3,) [m]."""
    report, fit = done.report, done.scored
    kept = ~report.wrong[report.sets.train]
    train = report.samples.select(report.sets.train).select(kept)
    true = _truth(fit, exact, cell, tool)
    if true is None:
        return FromTruth(np.nan, np.nan, np.nan, False)
    again = identify(true.start, train, fit.parameters, cell.distances, begin=true.values)
    less = _cost(fit, fit, train) - _cost(again, fit, train)
    return FromTruth(_rms(again, report.scored), less, _rms(true, report.scored), True)


@dataclass(frozen=True)
class BesideTruth:
    """What a calibration with effects leaves, in ratios: over what the truth leaves of the same held-out stations; over
    the same model fitted from the values that stations without noise give it. expected: the first, by the covariance of
    the values. missing: what that model leaves of stations without noise, RMS over the truth's.
    """

    over_truth: float
    expected: float
    missing: float
    over_begun: float

    @property
    def words(self) -> str:
        """All four."""
        return (
            f"{self.over_truth:.2f} x the truth ({self.expected:.2f} by its values), lacks {self.missing:.2f}, "
            f"{self.over_begun:.3f} x begun there"
        )


def beside_truth(done: Solution, exact: Samples, cell: Cell) -> BesideTruth:
    """How a calibration compares with the truth. exact: its samples without noise."""
    report, fit = done.report, done.scored
    kept = ~report.wrong
    rows = report.sets.train[kept[report.sets.train]]
    start = fit.start.with_effects(fit.model.effects)
    true = identify(start, exact.select(rows), fit.parameters, cell.distances, robust=False, begin=fit.values)
    start = true.start.with_effects(true.model.effects)
    again = identify(start, report.samples.select(rows), fit.parameters, cell.distances, begin=true.values)
    rows = report.sets.held_out[kept[report.sets.held_out]]
    noise = report.samples.reading[rows] - exact.reading[rows]
    left = 1e3 * float(np.sqrt(np.mean(np.sum(noise**2, axis=1))))
    assert report.judged is not None
    assert report.judged.account_mm2 is not None
    estimation = {row.what: row.value for row in report.judged.account_mm2}["estimation"]
    final = _rms(fit, report.scored)
    return BesideTruth(
        final / left,
        float(np.sqrt(1.0 + estimation / left**2)),
        _rms(true, exact.select(rows)) / left,
        final / _rms(again, report.scored),
    )


def together(of_seeds: list[BesideTruth]) -> str:
    """A row of a table with HEADS."""
    if not of_seeds:
        return " | " * HEADS.count("|")
    over, missing, begun = (
        np.array([getattr(o, k) for o in of_seeds]) for k in ("over_truth", "missing", "over_begun")
    )
    expected = np.sqrt(np.mean([o.expected**2 for o in of_seeds]))
    return (
        f"{np.median(over):.2f} | {over.max():.2f} | {expected:.2f} | {np.median(missing):.2f} | {missing.max():.2f} "
        f"| {begun.max():.3f}"
    )


def _truth(fit: Fit, exact: Samples, cell: Cell, tool: np.ndarray) -> Fit | None:
    """The fit that leaves nothing of exact samples, begun where this one is or about the true tool."""
    about = replace(fit.start, T_tip_tool=se3.transform(fit.start.T_tip_tool[:3, :3], tool))
    for start, begin in ((fit.start, fit.values), (with_bases(about, exact, cell), None)):
        with_all = identify(start, exact, fit.parameters, cell.distances, robust=False, begin=begin)
        if _rms(with_all, exact) < TRUE_MM:
            return with_all
    return None


def _cost(fit: Fit, scale: Fit, samples: Samples) -> float:
    """Squares of what a fit leaves, and of its values in priors, in deviations of one scale for all fits."""
    prior = np.array([p.prior_std for p in fit.parameters])
    square = squared_residuals(errors(fit.model, samples), samples, scale.noise)
    return float(square.sum() + np.sum((fit.values / prior) ** 2))


def _rms(fit: Fit, samples: Samples) -> float:
    return 1e3 * float(np.sqrt(np.mean(errors(fit.model, samples).position_norm ** 2)))

"""What is taken out, and in again: effects that the final model does not need, and samples that are plainly wrong.

An effect that was worth having when it was found may cost nothing to do without once others stand beside it: it is
judged on *explain*, as when it was let in. One whose amplitudes are within two standard deviations of nothing, each and
together, says nothing, whatever it gains. A wrong reading stands alone. Where neighbours in time are off as well,
something happened to the robot, and that is for the scan to explain.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.calibration import (
    FITTED,
    AnyDistance,
    Fit,
    Model,
    NoiseModel,
    Uncertainty,
    as_normal,
    errors,
    identify,
    outlying,
    squared_residuals,
    uncertainty,
    uncontradicted,
    values_without,
    without,
)
from modcal_core.effects import Effect
from modcal_core.geometry import Array
from modcal_core.measurements import Samples

MIN_GAIN = 0.01  # share of the squared error on *explain* that an effect must take away: 0.5 % in RMS (sweep)
NOTHING = 2.0  # standard deviations within which an amplitude may be nothing: the usual 95 % interval holds 0
DRAWN_IN = 25.0  # times the median square, to which each sample's is limited, so that none rules alone
_NEIGHBOURS = 2  # on either side


def needless(
    fit: Fit, train: Samples, explain: Samples, noise: NoiseModel, distances: Sequence[AnyDistance] = (), keep: int = 0
) -> tuple[Fit, tuple[int, ...]]:
    """The fit to *train* without the effects it does not need, and the numbers of those that were taken out.

    noise: by which misses are measured. keep: so many effects at the beginning stay, whatever they are worth.
    """
    gone: list[int] = []
    left = list(range(len(fit.model.effects)))
    while len(left) > keep:
        known = uncertainty(fit.model, train, fit.parameters, fit, distances)
        limit, have = _limited(fit.model, explain, noise)
        costs = []
        for i in range(keep, len(left)):
            lost = _mean_square(without(fit.model, known, [i]), explain, noise, limit) / have - 1.0
            costs.append(-np.inf if is_nothing(fit.model.effects, i, known) else lost)
        weakest = int(np.argmin(costs))
        if costs[weakest] >= MIN_GAIN:
            break
        gone.append(left.pop(keep + weakest))
        moved, effects = values_without(fit.model, known, [keep + weakest])
        start = fit.start.with_effects(effects)
        fit = identify(start, train, fit.parameters, distances, tolerance=FITTED, begin=fit.values + moved)
    return fit, tuple(gone)


def is_nothing(effects: Sequence[Effect], number: int, known: Uncertainty) -> bool:
    """Whether each amplitude of one of the effects is within two standard deviations of nothing, and all together are.

    known: covariance of the fit's parameters and of its effects.
    """
    effect = effects[number]
    if (np.abs(effect.amplitudes) > NOTHING * effect.std[: len(effect.amplitudes)]).any():
        return False
    return joint_size(effects, number, known) <= NOTHING


def joint_size(effects: Sequence[Effect], number: int, known: Uncertainty) -> float:
    """How large an effect's amplitudes are together, as a number of standard deviations of one.

    Each may be as uncertain as the geometry that it can trade with, while a sum of them is known well: of an axis that
    wobbles once a turn one half is a tilt that turns with it, which is no fault, and the other half is.
    """
    amplitudes = effects[number].amplitudes
    first = len(known.parameters) + sum(len(effect.values) for effect in effects[:number])
    own = np.arange(first, first + len(amplitudes))
    C = known.covariance[np.ix_(own, own)]
    std = np.sqrt(np.maximum(np.diag(C), 1e-300))
    unit = amplitudes / std
    return as_normal(float(unit @ np.linalg.lstsq(C / np.outer(std, std), unit, rcond=1e-9)[0]), len(own))


def _limited(model: Model, samples: Samples, noise: NoiseModel) -> tuple[float, float]:
    """The limit that squares are brought in to, and their mean."""
    square = _squares(model, samples, noise)
    limit = DRAWN_IN * float(np.median(square)) + 1e-300
    return limit, float(np.mean(np.minimum(square, limit))) + 1e-300


def _mean_square(model: Model, samples: Samples, noise: NoiseModel, limit: float) -> float:
    return float(np.mean(np.minimum(_squares(model, samples, noise), limit)))


def _squares(model: Model, samples: Samples, noise: NoiseModel) -> Array:
    return squared_residuals(errors(model, samples), samples, noise)


def isolated_outliers(fit: Fit, samples: Samples) -> np.ndarray:
    """True for samples far outside the spread of the fit whose neighbours in time are not, (N,)."""
    far = outlying(fit.model, fit.noise, samples)
    order = np.lexsort((samples.stamps, samples.frame))
    of_order = far[order].astype(float)
    window = np.ones(2 * _NEIGHBOURS + 1)
    crowd = np.convolve(of_order, window, mode="same") - of_order
    alone = np.zeros(len(far), bool)
    alone[order] = crowd < _NEIGHBOURS
    return far & alone


def rejected_share(fit: Fit) -> float:
    """Share of the samples that a fit gives no weight."""
    return float(np.mean(fit.weights == 0.0))


def with_uncontradicted(final: Fit, train: Samples, distances: Sequence[AnyDistance]) -> tuple[Fit, np.ndarray | None]:
    """The fit with rejected samples taken in that nothing speaks against, if then fewer are rejected, and which these
    are, (N,); None where there are none.
    """
    rejected = final.weights == 0.0
    alone = uncontradicted(final.model, train, rejected)
    if not alone.any():
        return final, None
    start = final.start.with_effects(final.model.effects)
    some = train.select(~rejected | alone)
    bent = identify(start, some, final.parameters, distances, tolerance=FITTED, begin=final.values, reject=False)
    start = final.start.with_effects(bent.model.effects)
    again = identify(start, train, final.parameters, distances, tolerance=FITTED, begin=bent.values)
    if rejected_share(again) >= rejected_share(final):
        return final, None
    return again, alone & (again.weights > 0.0)

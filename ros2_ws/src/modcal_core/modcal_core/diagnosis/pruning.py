"""Effects that the final model does not need are taken out of it: judged on *explain*, as when they were let in.

An effect that was worth having when it was found may cost nothing to do without once others stand beside it. One whose
amplitudes are within two standard deviations of nothing says nothing, whatever it gains.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.calibration.distances import AnyDistance
from modcal_core.calibration.effects import Effect
from modcal_core.calibration.identify import FITTED, Fit, identify
from modcal_core.calibration.model import Model
from modcal_core.calibration.noise import Spread
from modcal_core.calibration.removal import without
from modcal_core.calibration.score import errors, squared_misses
from modcal_core.calibration.uncertainty import uncertainty
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples

LEAST_GAIN = 0.01  # share of the squared error on *explain* that an effect must take away to be worth having
NOTHING = 2.0  # standard deviations within which an amplitude may be nothing
_DRAWN_IN = 25.0  # times the median square, to which each sample's is limited, so that none rules alone


def needless(
    fit: Fit, train: Samples, explain: Samples, spread: Spread, distances: Sequence[AnyDistance] = (), keep: int = 0
) -> tuple[Fit, tuple[int, ...]]:
    """The fit to *train* without the effects it does not need, and the numbers of those that were taken out.

    spread: by which misses are measured. keep: so many effects at the beginning stay, whatever they are worth.
    """
    gone: list[int] = []
    left = list(range(len(fit.model.effects)))
    while len(left) > keep:
        known = uncertainty(fit.model, train, fit.parameters, fit, distances)
        limit, have = _limited(fit.model, explain, spread)
        costs = []
        for i in range(keep, len(left)):
            lost = _missed(without(fit.model, known, [i]), explain, spread, limit) / have - 1.0
            costs.append(-np.inf if is_nothing(fit.model.effects[i]) else lost)
        weakest = int(np.argmin(costs))
        if costs[weakest] >= LEAST_GAIN:
            break
        gone.append(left.pop(keep + weakest))
        effects = fit.model.effects
        start = fit.start.with_effects(effects[: keep + weakest] + effects[keep + weakest + 1 :])
        fit = identify(start, train, fit.parameters, distances, tolerance=FITTED, begin=fit.values)
    return fit, tuple(gone)


def is_nothing(effect: Effect) -> bool:
    """Whether each of the effect's amplitudes is within two standard deviations of nothing."""
    count = len(effect.amplitudes)
    return bool((np.abs(effect.amplitudes) <= NOTHING * effect.std[:count]).all())


def _limited(model: Model, samples: Samples, spread: Spread) -> tuple[float, float]:
    """The limit that squares are brought in to, and their mean."""
    square = _squares(model, samples, spread)
    limit = _DRAWN_IN * float(np.median(square)) + 1e-300
    return limit, float(np.mean(np.minimum(square, limit))) + 1e-300


def _missed(model: Model, samples: Samples, spread: Spread, limit: float) -> float:
    return float(np.mean(np.minimum(_squares(model, samples, spread), limit)))


def _squares(model: Model, samples: Samples, spread: Spread) -> Array:
    return squared_misses(errors(model, samples), samples, spread)

"""Samples that are plainly wrong are found before anything is made of the rest, and in the end some are taken in again.

A wrong reading stands alone. Where neighbours in time are off as well, something happened to the robot, and that is for
the scan to explain.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.calibration import FITTED, AnyDistance, Fit, identify, outlying, uncontradicted
from modcal_core.measurements import Samples

_NEIGHBOURS = 2  # on either side


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

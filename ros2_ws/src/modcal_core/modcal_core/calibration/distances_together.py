"""Whether known distances are wrong alike, which each of them alone cannot show: the others hold the scale for it.

Without all of them the arm's own lengths, as well as they are known, give the scale. What the readings and the arm then
say of each distance is compared with what is stated; one factor that all stated distances share is estimated from that.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.calibration.distances import CONTRADICTED, AnyDistance, distance_rows
from modcal_core.calibration.identify import Fit, identify
from modcal_core.calibration.scale import scale_without_distances
from modcal_core.calibration.uncertainty import Uncertainty, uncertainty
from modcal_core.errors import NotEnoughData
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples


def contradicted_together(fit: Fit, samples: Samples, distances: Sequence[AnyDistance]) -> tuple[str, ...]:
    """A sentence where one factor common to all known distances is contradicted by readings and arm.

    The fit is made once more without any of them: what they pull the readings away from would else be taken for the
    noise of these, and make room for themselves. For fixed points see :mod:`modcal_core.calibration.scale`.
    """
    if len(distances) < 2:
        return ()
    scale = scale_without_distances(fit, samples, distances)
    if scale is not None:
        each = [d.distance**2 / (d.std**2 + 2.0 * fit.noise.position**2) for d in distances]
        factor, std = -scale.longer, float(np.hypot(scale.std, sum(each) ** -0.5))
    else:
        try:
            free = without_distances(fit, samples)
        except NotEnoughData:  # nothing but the distances tells these parameters
            return ()
        factor, std = common_factor(free, uncertainty(free.model, samples, free.parameters, free), distances)
    if abs(factor) <= CONTRADICTED * std:
        return ()
    return (
        f"The {len(distances)} known distances together are stated {100.0 * factor:+.2f} ± {100.0 * std:.2f} % longer "
        "than readings and arm say: check that they are written down as they were measured, and are in the right unit.",
    )


def without_distances(fit: Fit, samples: Samples) -> Fit:
    """The fit of the same parameters and effects to these samples alone. Raises NotEnoughData where they are few."""
    start = fit.start.with_effects(fit.model.effects)
    return identify(start, samples, fit.parameters, begin=fit.values)


def common_factor(free: Fit, known: Uncertainty, distances: Sequence[AnyDistance]) -> tuple[float, float]:
    """By which share all stated distances are too long, and its deviation.

    free: a fit that has not seen them. known: the uncertainty of its model. Modelled distances have the covariance
    J C Jᵀ, stated ones their variances; what the model leaves unexplained of either end comes on top.
    """
    values = np.concatenate([np.zeros(len(known.parameters)), *(e.values for e in free.model.effects)])
    rows = distance_rows(free.model, known.parameters, values, distances)
    stated: Array = np.array([d.distance for d in distances])
    modelled = rows.J.T @ known.covariance @ rows.J
    total = modelled + np.diag([d.std**2 + 2.0 * free.noise.position**2 for d in distances])
    weighed = np.linalg.solve(total, stated)
    precision = float(stated @ weighed)
    return float(weighed @ rows.residual) / precision, precision**-0.5

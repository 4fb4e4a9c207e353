"""Whether known distances are wrong alike, which each of them alone cannot show: the others hold the scale for it.

Without all of them the arm's own lengths, as well as they are known, give the scale. What the readings and the arm then
say of each distance is compared with what is stated; one factor that all stated distances share is estimated from that.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modcal_core.calibration.distances import AnyDistance, distance_rows
from modcal_core.calibration.identify import Fit
from modcal_core.calibration.known_distances import CONTRADICTED
from modcal_core.calibration.uncertainty import Uncertainty, uncertainty
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples

_ROUNDING = 1e-9


def contradicted_together(fit: Fit, samples: Samples, distances: Sequence[AnyDistance]) -> tuple[str, ...]:
    """A sentence where one factor common to all known distances is contradicted by readings and arm."""
    if len(distances) < 2:
        return ()
    known = uncertainty(fit.model, samples, fit.parameters, fit, distances)
    factor, std = common_factor(fit, known, distances)
    if abs(factor) <= CONTRADICTED * std:
        return ()
    return (
        f"The {len(distances)} known distances together are stated {100.0 * factor:+.2f} ± {100.0 * std:.2f} % longer "
        "than readings and arm say: see that they are written down as they were measured, and in the right unit.",
    )


def common_factor(fit: Fit, known: Uncertainty, distances: Sequence[AnyDistance]) -> tuple[float, float]:
    """By which share all stated distances are too long, and its deviation.

    known: the uncertainty of the fit's model, the distances included in it. With residuals r, rows J and stated
    variances S, the leverage is H = J C Jᵀ S⁻¹; without all distances the residuals were (I − H)⁻¹ r, and the modelled
    distances had the covariance (I − H)⁻¹ J C Jᵀ. What the model leaves unexplained of either end comes on top.
    """
    values = np.concatenate([np.zeros(len(known.parameters)), *(e.values for e in fit.model.effects)])
    rows = distance_rows(fit.model, known.parameters, values, distances)
    stated: Array = np.array([d.distance for d in distances])
    S = np.array([d.std**2 for d in distances])
    V = rows.J.T @ known.covariance @ rows.J
    free = np.eye(len(S)) - V / S
    free += _ROUNDING * np.eye(len(S))
    off = np.linalg.solve(free, rows.residual)
    spread = np.linalg.solve(free, V)
    total = 0.5 * (spread + spread.T) + np.diag(S + 2.0 * fit.spread.position**2)
    weighed = np.linalg.solve(total, stated)
    precision = float(stated @ weighed)
    return float(weighed @ off) / precision, precision**-0.5

"""Samples that are plainly wrong are found before anything is made of the rest.

A wrong reading stands alone. Where neighbours in time are off as well, something happened to the robot, and that is for
the scan to explain.
"""

from __future__ import annotations

import numpy as np

from modcal_core.calibration.identify import Fit
from modcal_core.calibration.score import outlying
from modcal_core.measurements.samples import Samples

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

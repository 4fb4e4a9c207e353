"""How accurate an arm will be once it has been calibrated from certain stations.

What is left of the position error, in a posture with derivatives G, is ``G θ`` with θ of the covariance that the fit
has (see :mod:`modcal_core.planning.rows`), and on top of it what the joints do not repeat. Sizes are over postures of
the workspace and over what the noise may turn out to be; the noise of the tracker itself is not part of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from modcal_core.geometry.so3 import Array

_DRAWS = 200  # for time: the mean of as many is known to some per cent
_SEED = 11  # the same draws every time, so that sets of stations are compared on equal terms


@dataclass(frozen=True)
class Accuracy:
    """rms, p95: of the calibrated arm's position error [m]. model: RMS of the part that the calibration leaves [m].
    repeat: RMS of the part that the joints do not repeat [m].
    """

    rms: float
    p95: float
    model: float
    repeat: float


@dataclass(frozen=True)
class Workspace:
    """Where accuracy counts. G: (N, 3, P) [m] per prior deviation of each parameter. repeat: mean squares (N,) [m²]."""

    G: Array
    repeat: Array

    @cached_property
    def gamma(self) -> Array:
        """Mean of GᵀG, (P, P): the mean square error is tr(C Γ)."""
        flat = self.G.reshape(-1, self.G.shape[2])
        return flat.T @ flat / len(self.G)

    def left(self, covariance: Array) -> float:
        """RMS position error [m] that this covariance leaves, without what the joints do not repeat."""
        return float(np.sqrt(np.sum(covariance * self.gamma)))

    def accuracy(self, covariance: Array) -> Accuracy:
        """The accuracy that this covariance (P, P) of the parameters, in units of their priors, leaves."""
        model = self.left(covariance) ** 2
        repeat = float(np.mean(self.repeat))
        rng = np.random.default_rng(_SEED)
        value, vector = np.linalg.eigh(covariance)
        theta = (vector * np.sqrt(np.maximum(value, 0.0))) @ rng.standard_normal((len(value), _DRAWS))
        error = self.G @ theta  # (N, 3, draws)
        error += np.sqrt(self.repeat / 3.0)[:, None, None] * rng.standard_normal(error.shape)
        p95 = float(np.percentile(np.linalg.norm(error, axis=1), 95.0))
        return Accuracy(float(np.sqrt(model + repeat)), p95, float(np.sqrt(model)), float(np.sqrt(repeat)))

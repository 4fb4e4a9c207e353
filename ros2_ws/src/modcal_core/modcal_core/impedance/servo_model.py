"""By how much servos lead what they move: a lag and a compliance of each, learned while the force sensor follows.

A servo holds what it moves with a force that grows by the way e by which its reference leads, less the lag with which
it follows a moving one. With the measured speed v and the load τ that it carries,

    e = l v + c τ + b,

with a lag l [s], a compliance c and a small rest b. Every row of a model is such a servo, with numbers of its own:
linear least squares with a prior, and with the variance of what they leave.

Which stack it is that holds a tool is not told. One that is stiff in its joints is a row a joint, whose load is the
torque −Jᵀ w of the felt wrench w; one that is stiff in the tool's axes is a row an axis, whose load is −w. Both are
learned, side by side; the one that predicts the tool's lead better is known by that.
"""

from __future__ import annotations

import numpy as np

from modcal_core.geometry import Array

_ALIKE = 4.0  # neighbouring moments that depart from the model alike: so much fewer they count
FEWEST = 4  # moments from which three numbers are learned
FLOOR = 2e-5  # rad or m: encoders; what is left of what was learned is as large or larger
_LAG_UNKNOWN = 0.5  # of the stated lag, by which that of a servo may differ before it is learned
_REST = 1e-4  # rad or m: what dry friction leaves in a lead as the arm stands


class ServoModel:
    """Rows e = l v + c τ + b, all learned at once.

    compliance (m,): of each, 0 where none stands out. unsure_by (m,): its standard deviation.
    """

    def __init__(self, softest: Array, lag: float) -> None:
        """softest (m,): compliance that a row may have before it is learned [rad/N m, m/N]. lag: stated [s]."""
        m = len(softest)
        self._guess = np.array([lag, 0.0, 0.0])
        prior = np.stack([np.full(m, max(_LAG_UNKNOWN * lag, 1e-4)), softest, np.full(m, _REST)], axis=1)
        self._prior = prior**-2.0  # (m, 3)
        self._sums = np.zeros((m, 4, 4))  # of products of speed, load, one and lead
        self.count = 0
        self._x, self._covariance = np.tile(self._guess, (m, 1)), np.zeros((m, 3, 3))
        self.compliance, self.unsure_by = np.zeros(m), np.asarray(softest, dtype=float)
        self._against = np.zeros((m, 4))  # what the four are multiplied by for what is left

    def learn(self, moment: Array) -> None:
        """Take a moment (m, 4): speed, load, one and lead of every row. :meth:`solve` makes use of it."""
        self._sums += moment[:, :, None] * moment[:, None, :]
        self.count += 1

    def solve(self) -> None:
        """Find lag, compliance and rest of all rows from the moments so far; fewer than four change nothing."""
        if self.count < FEWEST:
            return
        A, b, squares = self._sums[:, :3, :3], self._sums[:, :3, 3], self._sums[:, 3, 3]
        x, _ = self._solved(A, b, np.full(len(A), FLOOR**2))
        left = squares - 2.0 * (x * b).sum(axis=1) + np.einsum("ni,nij,nj->n", x, A, x)
        variance = np.maximum(left, 0.0) / (self.count - 3) + FLOOR**2
        self._x, self._covariance = self._solved(A, b, _ALIKE * variance)
        self.unsure_by = np.sqrt(self._covariance[:, 1, 1])
        self.compliance = np.where(self._x[:, 1] > self.unsure_by, self._x[:, 1], 0.0)
        self._against[:, :3], self._against[:, 3] = -self._x, 1.0

    def _solved(self, A: Array, b: Array, variance: Array) -> tuple[Array, Array]:
        weighted = A / variance[:, None, None]
        weighted[:, [0, 1, 2], [0, 1, 2]] += self._prior
        covariance = np.asarray(np.linalg.inv(weighted), dtype=float)
        return np.einsum("nij,nj->ni", covariance, b / variance[:, None] + self._prior * self._guess), covariance

    @property
    def lag(self) -> Array:
        """Lag of every row (m,) [s]; the stated one before anything is learned."""
        return self._x[:, 0]

    @property
    def lag_unsure_by(self) -> Array:
        """Standard deviations of the lags (m,) [s]."""
        return np.asarray(np.sqrt(self._covariance[:, 0, 0]))

    @property
    def rest(self) -> Array:
        """What dry friction and the like leave of every row (m,) [rad or m]."""
        return self._x[:, 2]

    def softness(self, levers: Array, least: Array) -> tuple[float, float] | None:
        """Measured compliance of the first rows as a share of the largest possible one, and its standard deviation.

        levers (n,): tool motion per row [m/rad]. least (n,): smallest possible stiffness [N m/rad], NaN where unknown;
        None where all are unknown. Rows are weighted by how far the loads of the learning phase moved the tool.
        """
        n = len(least)
        moved = np.where(np.isfinite(least), levers * np.sqrt(self._sums[:n, 1, 1]), 0.0)
        most = float(np.nansum(moved / least))
        if not most > 0.0:
            return None
        return float(moved @ self._x[:n, 1]) / most, float(moved @ self.unsure_by[:n]) / most

    def left(self, mean: Array) -> Array:
        """What the model leaves (m,) of means (m, 4) of speed, load, one and lead."""
        return np.asarray((mean * self._against).sum(axis=1))

    def scatter(self, squares: Array, mean: Array) -> Array:
        """Variance (m,) of what is left of single readings; squares (m, 4, 4): mean products of the same four."""
        a = self._against
        return np.maximum(np.einsum("ni,nij,nj->n", a, squares, a) - (mean * a).sum(axis=1) ** 2, 0.0)

    def unsure(self, change: Array) -> Array:
        """Variance (m,) of the prediction for a change (m, 4) of the four inputs."""
        z = change[:, :3]
        return np.einsum("ni,nij,nj->n", z, self._covariance, z)

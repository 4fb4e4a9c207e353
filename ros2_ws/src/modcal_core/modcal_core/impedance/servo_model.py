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

from modcal_core.geometry.so3 import Array

_ALIKE = 4.0  # neighbouring moments that depart from the model alike: so much fewer they count
FEWEST = 4  # moments from which three numbers are learned
_FLOOR = 5e-5  # rad or m: encoders, friction in the joints
_LAG_UNKNOWN = 0.5  # of the stated lag, by which that of a servo may differ before it is learned
_REST = 1e-4  # rad or m: what dry friction leaves in a lead as the arm stands
_JITTER = 2e-3  # s by which a reading may be of another time than its stamp says
_BEYOND = 0.5  # of what a load larger than any that was learned of explains: a servo need not be linear


class ServoModel:
    """Rows e = l v + c τ + b, all learned at once."""

    def __init__(self, softest: Array, lag: float) -> None:
        """softest (m,): compliance that a row may have before it is learned [rad/N m, m/N]. lag: stated [s]."""
        m = len(softest)
        self._guess = np.array([lag, 0.0, 0.0])
        prior = np.stack([np.full(m, max(_LAG_UNKNOWN * lag, 1e-4)), softest, np.full(m, _REST)], axis=1)
        self._prior = prior**-2.0  # (m, 3)
        self._sums = np.zeros((m, 4, 4))  # of products of speed, load, one and lead
        self.count = 0
        self._largest = np.zeros(m)  # load that was learned of
        self._x, self._covariance, self._variance = np.tile(self._guess, (m, 1)), np.zeros((m, 3, 3)), np.zeros(m)

    def learn(self, speed: Array, load: Array, lead: Array) -> None:
        """Take a moment: speeds, loads and leads of the rows (m,). :meth:`solve` makes use of it."""
        z = np.stack([speed, load, np.ones(len(speed)), lead], axis=1)
        self._sums += z[:, :, None] * z[:, None, :]
        self.count += 1
        self._largest = np.maximum(self._largest, np.abs(load))

    def solve(self) -> None:
        """Find lag, compliance and rest of all rows from the moments so far; fewer than four change nothing."""
        if self.count < FEWEST:
            return
        A, b, squares = self._sums[:, :3, :3], self._sums[:, :3, 3], self._sums[:, 3, 3]
        x, _ = self._solved(A, b, np.full(len(A), _FLOOR**2))
        left = squares - 2.0 * (x * b).sum(axis=1) + np.einsum("ni,nij,nj->n", x, A, x)
        self._variance = np.maximum(left, 0.0) / (self.count - 3) + _FLOOR**2
        self._x, self._covariance = self._solved(A, b, _ALIKE * self._variance)

    def _solved(self, A: Array, b: Array, variance: Array) -> tuple[Array, Array]:
        weighted = A / variance[:, None, None]
        weighted[:, [0, 1, 2], [0, 1, 2]] += self._prior
        covariance = np.asarray(np.linalg.inv(weighted), dtype=float)
        return np.einsum("nij,nj->ni", covariance, b / variance[:, None] + self._prior * self._guess), covariance

    def predicted(self, speed: Array, load: Array) -> Array:
        """The leads (m,) that speeds and loads (m,) take."""
        return self._x[:, 0] * speed + self._x[:, 1] * load + self._x[:, 2]

    def spread(self, speed: Array, load: Array) -> Array:
        """By how much leads (m,) depart from that, one standard deviation."""
        z = np.stack([speed, load, np.ones(len(speed))], axis=1)
        beyond = _BEYOND * self._x[:, 1] * np.maximum(np.abs(load) - self._largest, 0.0)
        known = np.einsum("ni,nij,nj->n", z, self._covariance, z)
        return np.sqrt(self._variance + known + beyond**2 + (_JITTER * speed) ** 2)

    def compliance(self, deviations: float) -> Array:
        """Compliance (m,), zero where it is not as many standard deviations from zero: such a row shows no force."""
        c = self._x[:, 1]
        return np.where(c > deviations * np.sqrt(self._covariance[:, 1, 1]), c, 0.0)

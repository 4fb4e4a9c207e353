"""By how much the references of servos lead what they move: e = l v + c τ + b, learned row by row.

v is the measured speed and τ the load that a servo carries. Lag l [s], compliance c and rest b are its own. A stack
that is stiff in its joints has a row a joint, whose load is the torque −Jᵀ w of the felt wrench w; one that is stiff in
the tool's axes has a row an axis, whose load is −w. Both are learned side by side by least squares with a prior.
"""

from __future__ import annotations

import math

import numpy as np

from modcal_core.geometry import Array

_ALIKE = 4.0  # neighbouring moments that depart from the model alike: so much fewer they count
_FEWEST = 4  # moments from which three numbers are learned
FLOOR = 2e-5  # rad or m: encoders; what is left of what was learned is as large or larger
_LAG_UNKNOWN = 0.5  # of the stated lag, by which that of a servo may differ before it is learned
_REST = 1e-4  # rad or m: what dry friction leaves in a lead as the arm stands
_SURE = 3.0  # standard deviations within which a number surely is
_FORGETS = 0.98  # of the errors of predictions, with every moment
_LEVER = 0.1  # m: shortest lever of a joint that counts as holding the tool
# N, N m: how large it may be where nothing shows it; a hand holds a handle some centimetres off its middle at most
_PRIOR = np.diag([200.0**-2.0] * 3 + [3.0**-2.0] * 3)
_WORSE = 1.5  # times the other stack's error: then it is the other one


class ServoModel:
    """Rows of n joints, then of the tool's six axes, all learned at once. x (n + 6, 3): lag, compliance and rest."""

    def __init__(self, softest: Array, lag: float) -> None:
        """softest (n + 6,): largest compliance of each row before it is learned [rad/N m, m/N]. lag: stated [s]."""
        m = len(softest)
        self._n, self._guess = m - 6, np.array([lag, 0.0, 0.0])
        prior = np.stack([np.full(m, max(_LAG_UNKNOWN * lag, 1e-4)), softest / _SURE, np.full(m, _REST)], axis=1)
        self._prior = prior**-2.0
        self._sums = np.zeros((m, 4, 4))  # of products of speed, load, one and lead
        self._errors = np.zeros(2)  # m², of what the joints' rows and the axes' predict of the tool
        self.count = 0
        self.x = np.tile(self._guess, (m, 1))
        self._covariance, self._scatter = np.apply_along_axis(np.diag, 1, prior**2), np.full(m, FLOOR**2)

    @property
    def known(self) -> bool:
        """Whether anything was learned."""
        return self.count >= _FEWEST

    def learn(self, moment: Array, J: Array) -> None:
        """Take a moment (n + 6, 4): speed, load, one and lead of every row. J (6, n): the tool's Jacobian."""
        if self.known:
            left = moment[:, 3] - (moment[:, :3] * self.x).sum(axis=1)
            ways = J[:3] @ left[: self._n], left[self._n : self._n + 3]
            self._errors += (1.0 - _FORGETS) * (np.array([way @ way for way in ways]) - self._errors)
        self._sums += moment[:, :, None] * moment[:, None, :]
        self.count += 1

    def solve(self) -> None:
        """Find the numbers of all rows from the moments so far."""
        if not self.known:
            return
        A, b, squares = self._sums[:, :3, :3], self._sums[:, :3, 3], self._sums[:, 3, 3]
        x = self._solved(A, b, np.full(len(A), FLOOR**2))[0]
        left = squares - 2.0 * (x * b).sum(axis=1) + np.einsum("ni,nij,nj->n", x, A, x)
        self._scatter = np.maximum(left, 0.0) / (self.count - 3) + FLOOR**2
        self.x, self._covariance = self._solved(A, b, _ALIKE * self._scatter)

    def _solved(self, A: Array, b: Array, variance: Array) -> tuple[Array, Array]:
        weighted = A / variance[:, None, None]
        weighted[:, [0, 1, 2], [0, 1, 2]] += self._prior
        covariance = np.asarray(np.linalg.inv(weighted), dtype=float)
        return np.einsum("nij,nj->ni", covariance, b / variance[:, None] + self._prior * self._guess), covariance

    @property
    def unsure(self) -> Array:
        """Standard deviations of the compliances (n + 6,)."""
        return np.sqrt(self._covariance[:, 1, 1])

    def spread(self, at: Array) -> Array:
        """Standard deviations (n + 6,) of leads, at speeds, loads and ones (n + 6, 3)."""
        return np.asarray(np.sqrt(np.einsum("ni,nij,nj->n", at, self._covariance, at) + self._scatter))

    @property
    def held(self) -> tuple[bool, bool]:
        """Whether it may be the joints that are held, and the tool's axes, by what their rows have predicted."""
        joints, axes = self._errors
        return bool(joints <= _WORSE**2 * axes or axes == 0.0), bool(axes <= _WORSE**2 * joints or joints == 0.0)

    def stiffness(self, way: Array, J: Array, axes: bool, most: float) -> float:
        """Largest stiffness [N/m] along a way (3,), of length 1, up to the most. axes: whether those are held."""
        levers, rows = (way, slice(self._n, self._n + 3)) if axes else (J[:3].T @ way, slice(0, self._n))
        yields = float(levers**2 @ (self.x[rows, 1] - _SURE * self.unsure[rows]))
        return min(1.0 / max(yields, 1e-9), most)

    def force(self, left: Array, spread: Array, J: Array, axes: bool, most: float) -> float:
        """The force [N] of the smallest wrench that takes what is left of leads (n + 6,), where some of it stands out.

        spread (n + 6,): their standard deviations. J (6, n): the tool's Jacobian. axes: whether those are held. most:
        stiffness of the tool at most [N/m], of rows whose compliance is not known.
        """
        rows, L = (slice(self._n, None), np.eye(6)) if axes else (slice(0, self._n), J)
        left, spread = left[rows], spread[rows]
        if (np.abs(left) <= _SURE * spread).all():
            return 0.0
        stiff = 1.0 / (most * np.maximum((L[:3] ** 2).sum(axis=0), _LEVER**2))
        takes = np.maximum(self.x[rows, 1] - self.unsure[rows], stiff)
        A = -(takes / spread)[:, None] * L.T
        wrench = np.linalg.solve(A.T @ A + _PRIOR, A.T @ (left / spread))
        return math.sqrt(wrench[:3] @ wrench[:3])

    def softness(self, J: Array, least: Array) -> tuple[float, float] | None:
        """Compliance of the joints as a share of what it is at most, and its standard deviation; None while unknown.

        J (6, n): the tool's Jacobian. least (n,): stiffness of each joint at least [N m/rad], NaN where unknown. Joints
        count by how far their loads have moved the tool.
        """
        n = self._n
        moved = np.sqrt((J[:3] ** 2).sum(axis=0) * self._sums[:n, 1, 1])
        moved = np.where(np.isfinite(least), moved, 0.0)
        most = float(np.nansum(moved / least))
        if not (most > 0.0 and self.known and self.held[0]):
            return None
        return float(moved @ self.x[:n, 1]) / most, float(moved @ self.unsure[:n]) / most

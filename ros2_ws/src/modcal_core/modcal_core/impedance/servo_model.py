"""By how much the references of servos lead what they move: e = l v + c τ + f s + b, learned row by row.

v is the measured speed, τ the load that a servo carries, and s the side on which dry friction acts, −1 … 1: of a servo
that stands it may be anything between. Lag l [s], compliance c, friction f and rest b are its own. A stack
that is stiff in its joints has a row a joint, whose load is the torque −Jᵀ w of the felt wrench w; one that is stiff in
the tool's axes has a row an axis, whose load is −w. Both are learned side by side by least squares with a prior.
"""

from __future__ import annotations

import math

import numpy as np

from modcal_core.geometry import Array

_ALIKE, _AT_MOST = 4.0, 0.95  # neighbouring moments depart from the model alike: so much fewer they count; correlation
_FEWEST = 5  # moments from which four numbers are learned
_SLIDES = 3e-3  # rad/s or m/s at which half of the friction is sure to act against the speed
_DRY = 2e-4  # rad or m: what dry friction takes
_FIRST, _SCATTER = 8, 5e-5  # moments that what is thought of the scatter before counts for; rad or m, that scatter
_STANDING = 1.0 / 3.0  # of friction's square, the variance of what may be anywhere between both sides
_LAG_UNKNOWN = 0.5  # of the stated lag, by which that of a servo may differ before it is learned
_REST = 1e-4  # rad or m: what dry friction leaves in a lead as the arm stands
_LIKELY, _SURE = 2.0, 3.0  # standard deviations within which a number likely and surely is
_LAST = 50  # moments whose errors of prediction are remembered
_LEVER = 0.1  # m: shortest lever of a joint that counts as holding the tool
# N, N m: how large it may be where nothing shows it; a hand holds a handle some centimetres off its middle at most. And
# deviations by which all servos may be softer than thought
_PRIOR = np.diag([200.0**-2.0] * 3 + [3.0**-2.0] * 3 + [1.0])
_ODDS = math.log(100.0)  # by which the other stack is likelier: then it is that one
_ENCODERS = 2e-5  # m: no prediction of the tool is better


class ServoModel:
    """Rows of n joints, then of the tool's six axes, all learned at once.

    x (n + 6, 4): lag, compliance, friction and rest.
    """

    def __init__(self, softest: Array, lag: float) -> None:
        """softest (n + 6,): largest compliance of each row before it is learned [rad/N m, m/N]. lag: stated [s]."""
        m = len(softest)
        self._n, self._guess = m - 6, np.array([lag, 0.0, 0.0, 0.0])
        lags, dry, rest = (np.full(m, value) for value in (max(_LAG_UNKNOWN * lag, 1e-4), _DRY, _REST))
        prior = np.stack([lags, softest / _LIKELY, dry, rest], axis=1)
        self._prior = prior**-2.0
        self._sums = np.zeros((m, 5, 5))  # of products of speed, load, side, one and lead
        self._errors = np.zeros(2)  # m², of what the joints' rows and the axes' predict of the tool
        self._judged, self._left, self._alike = 0, np.zeros(m), np.zeros((m, 2))  # predictions, last errors, products
        self.count = 0
        self.x = np.tile(self._guess, (m, 1))
        self._covariance, self._scatter = np.apply_along_axis(np.diag, 1, prior**2), np.full(m, _SCATTER**2)

    @property
    def known(self) -> bool:
        """Whether anything was learned."""
        return self.count >= _FEWEST

    def learn(self, moment: Array, J: Array) -> None:
        """Take a moment (n + 6, 5): speed, load, side, one and lead of every row. J (6, n): the tool's Jacobian."""
        if self.known:
            left = moment[:, 4] - (moment[:, :4] * self.x).sum(axis=1)
            ways = J[:3] @ left[: self._n], left[self._n : self._n + 3]
            self._alike += np.stack([left * left, left * self._left], axis=1)
            self._left = left
            self._judged += 1
            self._errors += (np.array([way @ way for way in ways]) - self._errors) / min(self._judged, _LAST)
        self._sums += moment[:, :, None] * moment[:, None, :]
        self.count += 1

    def solve(self) -> None:
        """Find the numbers of all rows from the moments so far."""
        if not self.known:
            return
        A, b, squares = self._sums[:, :4, :4], self._sums[:, :4, 4], self._sums[:, 4, 4]
        x = self._solved(A, b, np.full(len(A), _SCATTER**2))[0]
        left = squares - 2.0 * (x * b).sum(axis=1) + np.einsum("ni,nij,nj->n", x, A, x)
        self._scatter = (np.maximum(left, 0.0) + _FIRST * _SCATTER**2) / (self.count - 4 + _FIRST)
        # what friction leaves stays for a while: by how much errors follow those before, so many fewer count
        share = np.clip(self._alike[:, 1] / np.maximum(self._alike[:, 0], 1e-30), 0.0, _AT_MOST)
        self.x, self._covariance = self._solved(A, b, np.maximum(_ALIKE, (1 + share) / (1 - share)) * self._scatter)

    def _solved(self, A: Array, b: Array, variance: Array) -> tuple[Array, Array]:
        weighted = A / variance[:, None, None]
        weighted[:, range(4), range(4)] += self._prior
        covariance = np.asarray(np.linalg.inv(weighted), dtype=float)
        return np.einsum("nij,nj->ni", covariance, b / variance[:, None] + self._prior * self._guess), covariance

    @property
    def unsure(self) -> Array:
        """Standard deviations of the compliances (n + 6,)."""
        return np.sqrt(self._covariance[:, 1, 1])

    def spread(self, at: Array) -> Array:
        """Standard deviations (n + 6,) of leads, at speeds, loads, sides and ones (n + 6, 4)."""
        stands = (1.0 - np.abs(at[:, 2])) ** 2 * (self.x[:, 2] ** 2 + self._covariance[:, 2, 2])
        known = np.einsum("ni,nij,nj->n", at, self._covariance, at)
        return np.asarray(np.sqrt(known + _STANDING * stands + self._scatter))

    def rows(self, speed: Array, load: Array, lead: Array) -> Array:
        """A moment (m, 5) from speeds, loads and leads (m,)."""
        return np.stack([speed, load, speed / (np.abs(speed) + _SLIDES), np.ones(len(speed)), lead], axis=1)

    @property
    def held(self) -> tuple[bool, bool]:
        """Whether it may be the joints that are held, and the tool's axes, by what their rows have predicted."""
        joints, axes = self._errors + _ENCODERS**2
        odds = 1.5 * min(self._judged, _LAST) / _ALIKE * math.log(joints / axes)  # three numbers a prediction
        return odds <= _ODDS, -odds <= _ODDS

    def stiffness(self, way: Array, J: Array, axes: bool, most: float) -> float:
        """Largest stiffness [N/m] along a way (3,), of length 1, up to the most. axes: whether those are held."""
        levers, rows = (way, slice(self._n, self._n + 3)) if axes else (J[:3].T @ way, slice(0, self._n))
        yields = float(levers**2 @ (self.x[rows, 1] - _SURE * self.unsure[rows]))
        return min(1.0 / max(yields, 1e-9), most)

    def force(self, left: Array, spread: Array, load: Array, J: Array, axes: bool, most: float) -> float:
        """The force [N] of the smallest wrench that takes what is left of leads (n + 6,), where it stands out.

        spread (n + 6,): their standard deviations. load (n + 6,): that they carry. J (6, n): the tool's Jacobian.
        axes: whether those are held. most: stiffness of the tool at most [N/m], of rows whose compliance is not known.
        """
        rows, L = (slice(self._n, None), np.eye(6)) if axes else (slice(0, self._n), J)
        left, spread = left[rows], spread[rows]
        stiff = 1.0 / (most * np.maximum((L[:3] ** 2).sum(axis=0), _LEVER**2))
        takes = np.maximum(self.x[rows, 1] - self.unsure[rows], stiff)
        soft = self.unsure[rows] * load[rows]  # servos that are softer than thought are so together
        A = np.column_stack([-takes[:, None] * L.T, soft]) / spread[:, None]
        covariance = np.linalg.inv(A.T @ A + _PRIOR)
        force = covariance[:3] @ (A.T @ (left / spread))
        size = math.sqrt(force @ force)
        deviation = math.sqrt(force @ covariance[:3, :3] @ force) / max(size, 1e-9)
        return size - deviation if size > _SURE * deviation else 0.0

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

"""Whether the joints follow their references as far as the force that is felt explains, were they as soft as may be.

A force sensor that says a fifth of every force, from the start, teaches servos that yield five times as much, and then
explains whatever comes. What it cannot teach is a joint that yields more than the joints of this arm do: with a least
stiffness k of each, known beforehand, the load τ = Jᵀ w of the felt wrench w takes no more of a lead than |τ| / k. What
a joint leads by beyond that, its servo's lag taken off, is not felt. Asked of each joint by itself, what the hand
yields by sideways, where levers are long, explains little of what the arm is pulled by along itself.
"""

from __future__ import annotations

import math
from collections import deque
from operator import itemgetter

import numpy as np

from modcal_core.errors import BadCommand
from modcal_core.geometry.so3 import Array

_REMEMBERED = 0.5  # s of references
_LAGS = 1.5  # servo lags ago the reference may have been where the joint is now
_LAG_OFF = 0.5  # of the lag by which that may be misstated, in what a reference moves meanwhile
_BOTH_WAYS = 2.0  # times as late as readings come may a lead seem to be: references are on their way as well
_RECALL = 3.0  # servo lags for which a load that has gone still explains a lead: a servo unwinds by its lag
_SHARE = 0.4  # of the force that may go unfelt, for as much again comes until the arm stands
_IN_A_ROW = 3  # readings, for one may be late
_SETTLES = 3e-4  # rad that references have gone, up to which a lead is how the arm sags


class JointLeadCheck:
    """Take every tick; it answers why the pull must be let go, or None."""

    def __init__(self, least: Array, lag: float, period: float) -> None:
        """least (n,): stiffness that each joint has at least [N m/rad], NaN where that is not known. lag: of the servos
        [s]. period: of references and readings [s].
        """
        self._least, self._lag, self._period = least, lag, period
        self._sent: deque[tuple[float, Array]] = deque()
        self._loads: deque[tuple[float, Array]] = deque()
        self._begun: Array | None = None
        self._sag: Array | None = None
        self._stamp = -math.inf
        self._beyond = 0
        self._late: deque[tuple[float, float]] = deque()  # when, and by how much [s]

    def heard(self, stamp: float, now: float) -> None:
        """Note that the joints of ``stamp`` [s] are the newest now [s]: as late a reference may come to the servos."""
        silent = now - self._late[-1][0] - self._period if self._late else 0.0
        self._late.append((now, max(now - stamp, silent, 0.0)))
        while self._late[0][0] < now - _REMEMBERED:
            self._late.popleft()

    def sent(self, q: Array, now: float) -> None:
        """Note the reference (n,) that is sent at time ``now`` [s]."""
        self._begun = q.copy() if self._begun is None else self._begun
        self._sent.append((now, q.copy()))
        while self._sent[0][0] < now - _REMEMBERED:
            self._sent.popleft()

    def unexplained(self, q: Array, stamp: float, wrench: Array, J: Array) -> Array:
        """The lead (n,) [rad] of each joint that neither lag nor the felt wrench (6,) explains; zeros before a motion.

        q (n,): measured at ``stamp`` [s]. J (6, n): the tool's Jacobian, in its axes as the wrench.
        """
        ago = _LAGS * self._lag + _BOTH_WAYS * max(map(itemgetter(1), self._late), default=0.0)
        since = stamp - ago
        lately = [r for t, r in self._sent if since <= t <= stamp] or [r for t, r in self._sent if t <= stamp][-1:]
        if not lately or self._begun is None:
            return np.zeros(len(q))
        self._loads.append((stamp, np.abs(J.T @ wrench)))
        while self._loads[0][0] < stamp - _RECALL * self._lag:
            self._loads.popleft()
        references = np.array(lately)
        if self._sag is None or np.abs(references[-1] - self._begun).max() <= _SETTLES:
            self._sag = q - references[-1]
        at = q - self._sag
        beyond = np.maximum(references.min(axis=0) - at, at - references.max(axis=0))
        slack = _LAG_OFF * self._lag / ago * np.abs(np.diff(references, axis=0)).sum(axis=0)
        explained = np.max([load for _, load in self._loads], axis=0) / self._least
        return np.nan_to_num(np.maximum(beyond - slack - explained, 0.0))

    def refused(
        self, q: Array, stamp: float, wrench: Array, J: Array, most: float, stiffest: float
    ) -> BadCommand | None:
        """Why to let go: more than two fifths of ``most`` [N] may not be felt; None where all is well.

        stiffest: that the servos may hold the tool [N/m]. The rest as of :meth:`unexplained`.
        """
        if stamp <= self._stamp:
            return None
        self._stamp = stamp
        left = self.unexplained(q, stamp, wrench, J)
        way = left * np.sqrt((J[:3] ** 2).sum(axis=0))  # of the tool, by each joint at most [m]
        worst = int(np.argmax(way))
        self._beyond = self._beyond + 1 if way.sum() * stiffest > _SHARE * most else 0
        if self._beyond < _IN_A_ROW:
            return None
        felt = math.sqrt(wrench[:3] @ wrench[:3])
        said = (
            f"{felt:.0f} N are felt but a joint leads by {1e3 * left[worst]:.1f} mrad more than that takes on a servo "
            f"of {self._least[worst]:.0f} N m/rad"
        )
        return BadCommand("wrench", said, "check the force sensor, servo_lag_s and max_joint_lead_rad")

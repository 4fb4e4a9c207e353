"""Whether the joints follow their references as far as the force that is felt explains, were they as soft as may be.

A force sensor that says a fifth of every force, from the start, teaches servos that yield five times as much, and then
explains whatever comes. What it cannot teach is a joint that yields more than the joints of this arm do. A servo leads
what it moves by e = l v + τ / k, with its lag l, the measured speed v and the load τ = −Jᵀ w of the wrench w on the
tool. With a least stiffness k of each joint, known beforehand, the felt wrench takes no more of a lead than τ / k, and
towards its own side; and a joint that stands takes none by its lag, but for the moment in which it is sent off or
braked, when its inertia is a load. What a joint leads by beyond all of that is not felt.
Asked of each joint by itself, what the hand yields by sideways, where levers are long, explains little of what the arm
is pulled by along itself.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from modcal_core.errors import BadCommand
from modcal_core.geometry.so3 import Array
from modcal_core.impedance.recent_maximum import RecentMaximum

_REMEMBERED = 0.5  # s of references
_MAX_LAG = 2.0  # times the stated lag may a servo's be, as long as nothing was learned of it
_LAG_OFF, _SURE = 0.1, 3.0  # of a lag that was learned, and deviations of it, by which a servo's may differ
_MAX_REST = 3e-4  # rad of a rest that was learned: friction of 0.65 N m in a joint of 2175 N m/rad
_SPAN = 0.012  # s over which a speed is measured: three readings
_ON_ITS_WAY = 3.0  # periods that a reference may be now and then, although readings come in time
_BOTH_WAYS = 2.0  # times as late as readings come may a lead seem to be: references are on their way as well
_RECALL = 3.0  # servo lags for which a load that has gone still explains a lead: a servo unwinds by its lag
_SLOWS = 1.0  # servo lags for which a speed that has gone does: what a servo follows late it leaves late
_GATHERS = 1.0  # servo lags in which a reference that sets off has taken its joint along
_SHARE = 0.4  # of the force that may go unfelt, for as much again comes until the arm stands
_IN_A_ROW = 3  # readings, for one may be late
_SETTLES = 3e-5  # rad that references have gone, up to which a lead is how the arm sags: more is on its way


class JointLeadCheck:
    """Take every tick; it answers why the pull must be let go, or None."""

    def __init__(self, least: Array, lag: float, period: float) -> None:
        """least (n,): stiffness that each joint has at least [N m/rad], NaN where that is not known. lag: of the servos
        [s]. period: of references and readings [s].
        """
        self._least, self._lag, self._period = least, lag, period
        self._judges = bool(np.isfinite(least).any())  # else nothing is looked at: any lead may be the load's
        self._most_lag, self._rest = np.full(len(least), _MAX_LAG * lag), np.zeros(len(least))
        self._sent: deque[tuple[float, Array]] = deque()
        self._read: deque[tuple[float, Array]] = deque()
        self._speeds: deque[tuple[float, Array]] = deque()
        self._loads: deque[tuple[float, Array]] = deque()
        self._asked: deque[tuple[float, Array]] = deque()  # speeds of the references
        self._gained: deque[tuple[float, Array]] = deque()  # by how much these were lately faster and slower (2, n)
        self._begun: Array | None = None
        self._sag: Array | None = None
        self._stamp = -math.inf
        self._beyond = 0
        self._late, self._heard = RecentMaximum(_REMEMBERED), math.inf  # by how much [s], and when the last came

    def heard(self, stamp: float, now: float) -> None:
        """Note that joints of ``stamp`` [s] are the newest now [s]; references may reach the servos as late."""
        if not self._judges:
            return
        self._late.add(now, max(now - stamp, now - self._heard - self._period, 0.0))
        self._heard = now

    def sent(self, q: Array, now: float) -> None:
        """Note the reference (n,) that is sent at time ``now`` [s]."""
        if not self._judges:
            return
        self._begun = q.copy() if self._begun is None else self._begun
        self._sent.append((now, q.copy()))
        _forget(self._sent, now - _REMEMBERED)
        before = next(((t, r) for t, r in reversed(self._sent) if t <= now - _SPAN), self._sent[0])
        self._asked.append((now, (q - before[1]) / (now - before[0]) if now > before[0] else np.zeros(len(q))))
        late = _BOTH_WAYS * self._late.largest
        _forget(self._asked, now - _GATHERS * self._lag - late)
        speeds = np.array([speed for _, speed in self._asked])
        self._gained.append((now, np.stack([speeds[-1] - speeds.max(axis=0), speeds[-1] - speeds.min(axis=0)])))
        _forget(self._gained, now - _SLOWS * self._lag - late)

    def learned(self, lag: Array, unsure: Array, rest: Array) -> None:
        """Expect lags (n,) [s] of the servos as they were learned, with these standard deviations (n,) [s].

        rest: lead (n,) [rad] that neither lag nor load takes, as of dry friction.
        """
        self._rest = np.minimum(np.abs(rest), _MAX_REST)
        at_most = lag + _LAG_OFF * self._lag + _SURE * unsure
        self._most_lag = np.clip(at_most, _LAG_OFF * self._lag, _MAX_LAG * self._lag)

    def unexplained(self, q: Array, stamp: float, wrench: Array, J: Array) -> Array:
        """The lead (n,) [rad] of each joint that neither lag nor the felt wrench (6,) explains; zeros before a motion.

        q (n,): measured at ``stamp`` [s]. J (6, n): the tool's Jacobian, in its axes as the wrench.
        """
        late = _BOTH_WAYS * self._late.largest
        recent = sent_since(self._sent, stamp - late - _ON_ITS_WAY * self._period, stamp)
        if not recent or self._begun is None:
            return np.zeros(len(q))
        references = np.array(recent)
        self._read.append((stamp, q.copy()))
        _forget(self._read, stamp - _SPAN)
        begun, first = self._read[0]
        self._speeds.append((stamp, (q - first) / (stamp - begun) if stamp > begun else np.zeros(len(q))))
        _forget(self._speeds, stamp - _SLOWS * self._lag - late)
        self._loads.append((stamp, -J.T @ wrench))
        _forget(self._loads, stamp - _RECALL * self._lag)
        if self._sag is None or np.abs(references[-1] - self._begun).max() <= _SETTLES:
            self._sag = q - references[-1]
        at = q - self._sag
        gained = np.array([gain for _, gain in self._gained])
        lows = [self._lag * gained[:, 0].min(axis=0) - self._rest]
        highs = [self._lag * gained[:, 1].max(axis=0) + self._rest]
        for values, takes in ((self._speeds, self._most_lag), (self._loads, 1.0 / self._least)):
            some = np.array([value for _, value in values])
            lows.append(takes * np.minimum(some.min(axis=0), 0.0))
            highs.append(takes * np.maximum(some.max(axis=0), 0.0))
        ahead = references.min(axis=0) - at - sum(highs)
        behind = at - references.max(axis=0) + sum(lows)
        return np.nan_to_num(np.maximum(np.maximum(ahead, behind), 0.0))

    def refused(
        self, q: Array, stamp: float, wrench: Array, J: Array, most: float, stiffest: float
    ) -> BadCommand | None:
        """Why to let go: more than two fifths of ``most`` [N] may not be felt; None where all is well.

        stiffest: that the servos may hold the tool [N/m]. The rest as of :meth:`unexplained`.
        """
        if stamp <= self._stamp or not self._judges:
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


def sent_since(sent: deque[tuple[float, Array]], since: float, until: float) -> list[Array]:
    """What was sent between two times [s], the oldest first; where nothing was, what was sent last before them."""
    out: list[Array] = []
    for t, value in reversed(sent):  # the newest few of a hundred
        if t > until:
            continue
        if t >= since or not out:
            out.append(value)
        if t < since:
            break
    out.reverse()
    return out


def _forget(values: deque[tuple[float, Array]], before: float) -> None:
    """Take out what is older than a time [s]; the newest stays."""
    while len(values) > 1 and values[0][0] < before:
        values.popleft()

"""Whether the hand follows its setpoint as far as the force that is felt explains.

A servo pulls with its stiffness times the way by which its setpoint leads the tool. A force sensor that is stuck, or
not connected to what is held, hides that: the setpoint runs on, the hand does not, and what is felt stays small. So the
tool is compared with where its setpoint was a servo's lag ago, and with what the felt force takes on the softest stack
that is asked for. What is left, times the stiffness by which the servos hold the tool, is force that nobody feels. That
stiffness depends on the posture, and is largest along an outstretched arm; what the object and the fingers yield by
does not make it less, as the tool is measured. So the stiffest that an arm may be is what counts, and the lead may be
some tenths of a millimetre. A sensor that says the same to the last digit while the arm is
moved may be stuck, or coarse: what it says explains nothing. Where it always said something new before, it is stuck.

A sensor that is stuck while its noise goes on repeats nothing. But by how much the servos yield to a newton is learned
from what it said while it followed: whenever the felt force has changed by half a newton, the lead and the force of
that moment are noted, and from then on the force explains that lead and not what the softest stack would take. The arm
yields in another posture, and to another moment of the hand, by as much more or less as its levers say: by J Jᵀ w of
the felt wrench w, for joints that are alike.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from modcal_core.errors import BadCommand
from modcal_core.geometry.so3 import Array
from modcal_core.impedance.joint_lead_check import sent_since

_LAGS = 1.5  # servo lags ago the setpoint may have been where the tool is now
_REMEMBERED = 0.5  # s of setpoints
_MIN_LEAD = 1.5e-3  # m that are not explained, below which nothing is said: servos and measurements are no better
_MIN_SHARE = 0.4  # of the lead that takes the whole force, where that is less: what is stiff is pulled slowly
_SAME, _SAME_WAY = 5, 0.2e-3  # readings in a row that are alike to the last digit; m that the setpoint moved meanwhile
# Readings that must have differed before; how often as long as ever a sensor repeats itself when it is stuck, and for
# how long [s], while the setpoint moved by so much [m]: drivers send a reading again while the next is late, and what
# is coarse says the same as the arm stands
_DIFFERED, _AS_LONG, _STUCK, _STUCK_WAY = 100, 5, 0.1, 1e-3
_SOFTER = 3.0  # times softer than a contact may an arm be that is felt
_SHARE = 0.5  # of the force that may go unfelt, for as much again comes until the arm stands
_LAG_OFF = 0.5  # of the servo's lag by which that may be misstated, in what the setpoint moves meanwhile
_IN_A_ROW = 2  # measurements, for one may be late
_CHANGES = 0.5  # N by which a force must change to show that the sensor follows: three deviations of a usual noise
_FALLS = 2.0  # N by which a force must have fallen lately for its lead to be on its way back, and not to be noted
_STEADY, _GROWS = 1.3, 2.0  # times what was noted may a force take, and one that grew since: joints are not all alike
_RECALL = 3.0  # servo lags for which a force that has gone still explains a lead: a servo unwinds by its lag
_CREEP_SHARE = 0.2  # of the force that may come, in what a misstated lag hides of a setpoint that creeps
_SETTLES = 0.15e-3  # m that a setpoint has gone, up to which what it leads by is how the arm sags, and no force


@dataclass(frozen=True)
class Stiffness:
    """What is known beforehand. contact: of hand, arm and object [N/m], by which an unfelt force is judged.

    softest: of the stack that follows, by which a felt force is thought to lead [N/m]. lag: of its servo [s].
    stiffest: of a stiff stack, in any posture [N/m]; 0 where the stack is as compliant as it is asked to be.
    """

    contact: float
    softest: float
    lag: float
    stiffest: float = 0.0

    @property
    def name(self) -> str:
        """The parameter that states it."""
        return "arm_stiffness_n_m" if self.stiffest else "stiffness"

    @classmethod
    def of(cls, contact: float, stack: float, lag: float, stiffest: float) -> Stiffness:
        """From the stiffness of a contact, the ones asked of the stack and at most [N/m], and the servo's lag [s]."""
        return cls(contact, min(stack, contact / _SOFTER), lag, stiffest)


class LeadCheck:
    """Take every tick; it answers why the pull must be let go, or None."""

    def __init__(self, stiffness: Stiffness) -> None:
        self.stiffness = stiffness
        self._sent: deque[tuple[float, Array]] = deque()
        self._raw: tuple[float, ...] = ()
        self._stamp = -math.inf
        self._same, self._way = 0, 0.0
        self._differed, self._longest, self._changed = 0, 1, math.inf  # readings, readings in a row, stamp [s]
        self._gone, self._sag = 0.0, np.zeros(3)
        self._beyond = 0
        self._looked = -math.inf
        self._felt: deque[tuple[float, float, float]] = deque()  # stamp [s], force [N], what it moved [N m²]
        self._noted = (0.0, math.inf)  # what moved the levers [N m²], and the lead [m] per N m² that it came with

    def sent(self, p: Array, now: float) -> None:
        """Note where the setpoint (3,) [m] is at time ``now`` [s]."""
        if self._sent:
            step = math.dist(p, self._sent[-1][1])
            self._way += step
            self._gone += step
        self._sent.append((now, p.copy()))
        while self._sent[0][0] < now - _REMEMBERED:
            self._sent.popleft()

    def felt(self, raw: Array, stamp: float) -> None:
        """Note a reading (6,) of the force sensor, as it came."""
        if stamp <= self._stamp:
            return
        self._stamp, now = stamp, tuple(raw.tolist())
        if now == self._raw:
            self._same += 1
            return
        if not self.stuck:  # one that was stuck and says something again has taught nothing of how it is when sound
            self._longest = max(self._longest, self._same + 1)
        self._differed += 1
        self._raw, self._same, self._way, self._changed = now, 0, 0.0, stamp

    @property
    def repeats(self) -> bool:
        """Whether the sensor says the same again and again while the arm is moved."""
        return self._same >= _SAME and self._way >= _SAME_WAY

    @property
    def stuck(self) -> bool:
        """Whether the sensor repeats itself to the last digit for much longer than it ever did."""
        long = self._same >= _AS_LONG * self._longest and self._stamp - self._changed >= _STUCK
        return self._differed >= _DIFFERED and long and self._way >= _STUCK_WAY

    def creep(self, most: float) -> float:
        """The speed [m/s] at which what a misstated lag hides is a small share of a force [N]; inf where none is."""
        known = self.stiffness
        hides = _LAG_OFF * known.lag * known.stiffest
        return _CREEP_SHARE * most / hides if hides > 0.0 else math.inf

    def unfelt(self, tool: Array, force: float, stamp: float, most: float, moved: tuple[float, float] | None = None
               ) -> float:  # fmt: skip
        """The force [N] by which the setpoint pulls and that is not felt; 0 where a servo's lag may be all of it.

        tool (3,): measured at ``stamp`` [s]. force: that is felt; most: that may go unfelt [N]. moved: how far the
        felt wrench moves the tool of an arm whose joints yield by 1 rad to 1 N m, and one newton of it at most [N m²].
        """
        known = self.stiffness
        lately = sent_since(self._sent, stamp - _LAGS * known.lag, stamp)
        if not lately:
            return 0.0
        if known.stiffest and self._gone <= _SETTLES:
            self._sag = tool - lately[-1]
        tool = tool - self._sag
        if known.stiffest:
            slack = _LAG_OFF / _LAGS * sum(map(math.dist, lately[1:], lately[:-1]))
            left = min(math.dist(p, tool) for p in lately)
            explained = self._explained(left + slack, force, moved or (force, 1.0), stamp)
            return known.stiffest * max(left - explained - slack, 0.0)
        explained = 0.0 if self.repeats else force / known.softest
        left = min(math.dist(p, tool) for p in lately) - explained
        least = min(_MIN_LEAD, _MIN_SHARE * most / known.contact)
        if left <= least:
            return 0.0
        return known.contact * (math.dist(self._sent[-1][1], tool) - explained)  # as it will be, with no more lag

    def _explained(self, lead: float, force: float, moved: tuple[float, float], stamp: float) -> float:
        """The lead [m] that a felt force [N] takes, by what was noted of the servos; at most what the softest do.

        The largest of the last moments counts, for what lets go (a magnet) is felt at once and unwinds by the servo's
        lag. lead: that is there, with what the lag may be of it [m]. moved: as of :meth:`unfelt`.
        """
        by, newton = moved
        self._felt.append((stamp, force, by))
        while self._felt[0][0] < stamp - _RECALL * self.stiffness.lag:
            self._felt.popleft()
        if self.repeats:
            return 0.0
        noted, per = self._noted
        fell = max(f for _, f, _ in self._felt) > force + _FALLS
        if abs(by - noted) >= _CHANGES * newton and by > 0.0 and not fell:
            self._noted = noted, per = by, min(lead, force / self.stiffness.softest) / by
        return max(self._takes(noted, per))

    def _takes(self, noted: float, per: float) -> list[float]:
        """The leads [m] that the forces of the last moments take."""
        softest = self.stiffness.softest
        if not math.isfinite(per):
            return [force / softest for _, force, _ in self._felt]
        return [
            min(per * (_STEADY * by if by < noted else _STEADY * noted + _GROWS * (by - noted)), force / softest)
            for _, force, by in self._felt
        ]

    def refused(
        self, tool: Array, force: float, stamp: float, most: float, moved: tuple[float, float] | None = None
    ) -> BadCommand | None:
        """Why to let go: more than ``most`` [N] is not felt, or the sensor is stuck; None where all is well.

        moved: as of :meth:`unfelt`.
        """
        if stamp <= self._looked:
            return None
        self._looked = stamp
        hidden, stiff = self.unfelt(tool, force, stamp, most, moved), self.stiffness.stiffest > 0.0
        if self.stuck and self._sent:
            lead = math.dist(self._sent[-1][1], tool)
            repeats = (
                f"the force sensor says {force:.0f} N to the last digit, {self._same + 1} times in a row, never more "
                f"than {self._longest} before, while the setpoint leads the tool by {1e3 * lead:.1f} mm"
            )
            return BadCommand("wrench", repeats, "check the force sensor and its driver")
        self._beyond = self._beyond + 1 if hidden > (_SHARE if stiff else 1.0) * most else 0
        if self._beyond < (_IN_A_ROW if stiff else 1):
            return None
        lead = math.dist(self._sent[-1][1], tool)
        said = (
            f"{force:.0f} N are felt{', always the same,' if self.repeats else ''} but the setpoint leads the tool by "
            f"{1e3 * lead:.1f} mm, which may take {hidden:.0f} N more"
        )
        return BadCommand("wrench", said, f"check the force sensor, servo_lag_s and {self.stiffness.name}")

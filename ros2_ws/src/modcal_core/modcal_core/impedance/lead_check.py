"""Whether the hand follows its setpoint as far as the felt force explains.

A servo pulls with its stiffness times the way by which its setpoint leads the tool. A force sensor that is stuck, or
not connected to what is held, hides that: the setpoint runs on, the hand does not. So the tool is compared with where
its setpoint was a servo's lag ago. What neither the lag nor the felt force explains, times the stiffness of the servos,
is force that nobody feels. That stiffness depends on the posture, so the stiffest that an arm may be counts.

A sensor that repeats itself to the last digit while the arm is moved may be stuck, or coarse: what it says explains
nothing. Where it always said something new before, it is stuck. A stuck sensor may still show noise. So how far the
servos yield to a newton is learned while the sensor follows: whenever the felt force has changed by half a newton, lead
and force are noted, and from then on the force explains that lead and not what the softest stack would take; in another
posture as much more or less as J Jᵀ w of the felt wrench w says.

A sensor that says a fifth of every force from the start teaches servos that yield five times as much. It cannot teach a
joint that yields more than its stated least stiffness k allows. A servo leads what it moves by e = l v + τ / k, with
its lag l, the measured speed v and the load τ = −Jᵀ w. So a felt wrench takes at most τ / k of a lead, towards its own
side; and a joint that stands takes none by its lag, but while it is sent off or braked. More than that is not felt.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from modcal_core.errors import BadCommand
from modcal_core.geometry import Array
from modcal_core.impedance.task import JointPositions


class RecentMaximum:
    """The largest of the values of the last ``seconds``; 0 before the first. Times must not go back."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._falling: deque[tuple[float, float]] = deque()  # those that no later one exceeds: the first is the largest

    def add(self, now: float, value: float) -> None:
        """Note a value at time ``now`` [s], and forget what is too old."""
        values = self._falling
        while values and values[-1][1] <= value:
            values.pop()
        values.append((now, value))
        while values[0][0] < now - self._seconds:
            values.popleft()

    @property
    def largest(self) -> float:
        """Maximum over the last ``seconds``; 0 where there is none."""
        return self._falling[0][1] if self._falling else 0.0


_REMEMBERED = 0.5  # s of references and setpoints


class SentReferences:
    """References that were lately sent, and by how much readings lately came late [s]. begun (n,): the first one."""

    def __init__(self, period: float) -> None:
        """period: of references and readings [s]."""
        self._period = period
        self.values: deque[tuple[float, Array]] = deque()
        self.begun: Array | None = None
        self._late, self._heard = RecentMaximum(_REMEMBERED), math.inf  # by how much [s], and when the last came

    def heard(self, stamp: float, now: float) -> None:
        """Note that joints of ``stamp`` [s] are the newest now [s]; references may reach the servos as late."""
        self._late.add(now, max(now - stamp, now - self._heard - self._period, 0.0))
        self._heard = now

    def sent(self, q: Array, now: float) -> None:
        """Note the reference (n,) that is sent at time ``now`` [s]."""
        self.begun = q.copy() if self.begun is None else self.begun
        self.values.append((now, q.copy()))
        _forget(self.values, now - _REMEMBERED)

    @property
    def late(self) -> float:
        """The largest delay of the last half second [s]."""
        return self._late.largest

    def newest(self, until: float) -> Array | None:
        """The newest reference (n,) sent by then [s], or None."""
        return next((q for t, q in reversed(self.values) if t <= until), None)


_MAX_LAG = 2.0  # times the stated lag may a servo's be, as long as nothing was learned of it
_LAG_OFF, _SURE = 0.1, 3.0  # of a lag that was learned, and deviations of it, by which a servo's may differ
_MAX_REST = 3e-4  # rad of a rest that was learned: friction of 0.65 N m in a joint of 2175 N m/rad
_SPAN = 0.012  # s over which a speed is measured: three readings
_ON_ITS_WAY = 3.0  # periods that a reference may be now and then, although readings come in time
_BOTH_WAYS = 2.0  # times as late as readings come may a lead seem to be: references are on their way as well
_RECALL = 3.0  # servo lags for which a load or force that has gone still explains a lead: a servo unwinds by its lag
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
        self._references = SentReferences(period)
        self._judges = bool(np.isfinite(least).any())  # else nothing is looked at: any lead may be the load's
        self._most_lag, self._rest = np.full(len(least), _MAX_LAG * lag), np.zeros(len(least))
        self._read: deque[tuple[float, Array]] = deque()
        self._speeds: deque[tuple[float, Array]] = deque()
        self._loads: deque[tuple[float, Array]] = deque()
        self._asked: deque[tuple[float, Array]] = deque()  # speeds of the references
        self._gained: deque[tuple[float, Array]] = deque()  # by how much these were lately faster and slower (2, n)
        self._sag: Array | None = None
        self._stamp = -math.inf
        self._beyond = 0

    def heard(self, stamp: float, now: float) -> None:
        """As of :class:`SentReferences`."""
        if self._judges:
            self._references.heard(stamp, now)

    def sent(self, q: Array, now: float) -> None:
        """Note the reference (n,) that is sent at time ``now`` [s]."""
        if not self._judges:
            return
        self._references.sent(q, now)
        sent = self._references.values
        before = next(((t, r) for t, r in reversed(sent) if t <= now - _SPAN), sent[0])
        self._asked.append((now, (q - before[1]) / (now - before[0]) if now > before[0] else np.zeros(len(q))))
        late = _BOTH_WAYS * self._references.late
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

    def unexplained(self, q: Array, stamp: float, load: Array) -> Array:
        """The lead (n,) [rad] of each joint that neither lag nor its load explains; zeros before a motion.

        q (n,): measured at ``stamp`` [s]. load (n,): that is told of each joint, −Jᵀ w of a felt wrench w [N m].
        """
        late, begun = _BOTH_WAYS * self._references.late, self._references.begun
        recent = sent_since(self._references.values, stamp - late - _ON_ITS_WAY * self._period, stamp)
        if not recent or begun is None:
            return np.zeros(len(q))
        references = np.array(recent)
        self._read.append((stamp, q.copy()))
        _forget(self._read, stamp - _SPAN)
        since, first = self._read[0]
        self._speeds.append((stamp, (q - first) / (stamp - since) if stamp > since else np.zeros(len(q))))
        _forget(self._speeds, stamp - _SLOWS * self._lag - late)
        self._loads.append((stamp, load))
        _forget(self._loads, stamp - _RECALL * self._lag)
        if self._sag is None or np.abs(references[-1] - begun).max() <= _SETTLES:
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
        self, joints: JointPositions, load: Array, felt: float, J: Array, most: float, stiffest: float
    ) -> BadCommand | None:
        """Why to let go: more than two fifths of ``most`` [N] may not be felt; None where all is well.

        load: as of :meth:`unexplained`. felt: force that is told [N]. J (6, n): the tool's Jacobian. stiffest: that the
        servos may hold the tool [N/m].
        """
        if joints.stamp <= self._stamp or not self._judges:
            return None
        self._stamp = joints.stamp
        left = self.unexplained(joints.q, joints.stamp, load)
        way = left * np.sqrt((J[:3] ** 2).sum(axis=0))  # of the tool, by each joint at most [m]
        worst = int(np.argmax(way))
        self._beyond = self._beyond + 1 if way.sum() * stiffest > _SHARE * most else 0
        if self._beyond < _IN_A_ROW:
            return None
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


_LAGS = 1.5  # servo lags ago the setpoint may have been where the tool is now
_MIN_LEAD = 1.5e-3  # m that are not explained, below which nothing is said: servos and measurements are no better
_MIN_SHARE = 0.4  # of the lead that takes the whole force, where that is less: what is stiff is pulled slowly
_SAME, _SAME_WAY = 5, 0.2e-3  # readings in a row that are alike to the last digit; m that the setpoint moved meanwhile
# Readings that must have differed before; how often as long as ever a sensor repeats itself when it is stuck, and for
# how long [s], while the setpoint moved by so much [m]: drivers send a reading again while the next is late, and what
# is coarse says the same as the arm stands
_DIFFERED, _AS_LONG, _STUCK, _STUCK_WAY = 100, 5, 0.1, 1e-3
_SOFTER = 3.0  # times softer than a contact may an arm be that is felt
_UNFELT = 0.5  # of the force that may go unfelt, for as much again comes until the arm stands
_MISSTATED = 0.5  # of the servo's lag by which that may be misstated, in what the setpoint moves meanwhile
_REPEATED = 2  # measurements, for one may be late
_CHANGES = 0.5  # N by which a force must change to show that the sensor follows: three deviations of a usual noise
_FALLS = 2.0  # N by which a force must have fallen lately for its lead to be on its way back, and not to be noted
_STEADY, _GROWS = 1.3, 2.0  # times what was noted may a force take, and one that grew since: joints are not all alike
_CREEP_SHARE = 0.2  # of the force that may come, in what a misstated lag hides of a setpoint that creeps
_STANDS = 0.15e-3  # m that a setpoint has gone, up to which what it leads by is how the arm sags, and no force


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
        _forget(self._sent, now - _REMEMBERED)

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
        hides = _MISSTATED * known.lag * known.stiffest
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
        if known.stiffest and self._gone <= _STANDS:
            self._sag = tool - lately[-1]
        tool = tool - self._sag
        if known.stiffest:
            slack = _MISSTATED / _LAGS * sum(map(math.dist, lately[1:], lately[:-1]))
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
        softest = self.stiffness.softest
        if not math.isfinite(per):
            return max(force / softest for _, force, _ in self._felt)
        return max(
            min(per * (_STEADY * by if by < noted else _STEADY * noted + _GROWS * (by - noted)), force / softest)
            for _, force, by in self._felt
        )

    def refused(
        self, tool: Array, force: float, stamp: float, most: float, moved: tuple[float, float] | None = None
    ) -> BadCommand | None:
        """Why to let go: over ``most`` [N] is not felt, or the sensor is stuck; or None. moved: see :meth:`unfelt`."""
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
        self._beyond = self._beyond + 1 if hidden > (_UNFELT if stiff else 1.0) * most else 0
        if self._beyond < (_REPEATED if stiff else 1):
            return None
        lead = math.dist(self._sent[-1][1], tool)
        said = (
            f"{force:.0f} N are felt{', always the same,' if self.repeats else ''} but the setpoint leads the tool by "
            f"{1e3 * lead:.1f} mm, which may take {hidden:.0f} N more"
        )
        return BadCommand("wrench", said, f"check the force sensor, servo_lag_s and {self.stiffness.name}")

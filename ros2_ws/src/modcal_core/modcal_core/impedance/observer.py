"""Whether the wrench is to be believed: the force that is not felt, from everything else that tells of one.

Four streams leave a residual each, with a deviation.

* *Leads.* A servo holds what it moves by the lead of its reference, which :class:`ServoModel` predicts from speed and
  felt load. A lead that neither explains, at three deviations, is a way by which the tool is pulled and that nobody
  feels: times the stiffness of the servos, which is at most what is stated or was learned, it is a force. A load
  explains all leads from none up to what it takes on the softest servo, for as long as a servo needs to unwind, and a
  reference may have come as late as messages do.
* *Compliance.* A sensor that tells a fifth of every force makes servos seem five times as soft. Where it is known by
  how much the joints of this arm yield at most, it is the sensor that is wrong. All moments count for that, suspected
  ones too: loads are small until something jams.
* *Efforts* of the joints show a wrench of their own.
* *Repetition.* A sensor that says the same to the last digit for much longer than it ever did is stuck.

The largest of the forces is hidden. It slows the pull down as a felt one does, and where it stays above what may be
hidden the pull is over; why is told by the stream that shows it.

What is learned must not explain a jam. A moment is learned only when nothing was suspected for a while after it, and
when the felt force has changed since or the tool has gone on by more than the softest fingers yield: a sensor that has
frozen teaches nothing, however long the lead grows.

*Motion* tells how fast to go meanwhile. At what does not move any sensor tells something in the end; one that has told
of a force with which the tool went on, and that makes servos no softer than they may be, needs no caution.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from modcal_core.errors import BadCommand
from modcal_core.geometry import Array
from modcal_core.impedance.servo_model import ServoModel
from modcal_core.impedance.task import ImpedanceTask, JointPositions

_REMEMBERED = 0.5  # s of references, and of how late messages came
_SPAN = 0.012  # s over which a joint's speed is measured: three readings at 250 Hz
_MEAN = 0.04  # s over which what is learned is averaged: noise is a third of what it is in one reading
_RECALL = 3.0  # servo lags for which a load that has gone still explains a lead: a servo unwinds by its lag
_SETTLES = 3e-5  # rad that references have gone, up to which a lead is how the arm sags, and no force
_SURE, _LIKELY = 3.0, 2.0  # standard deviations by which a force stands out, and a sensor is believed
_SOFTEST = 3e-3  # rad/N m or m/N: compliance of a joint of which nothing is known, a soft wrist
_STATED = 1.7  # times as soft as stated may joints be: by half, and drives' friction makes as much as a tenth of it
_DELAY = 0.25  # s after which a moment is learned: a jam is suspected within a tenth of that
_CHANGED = 0.5, 0.05  # N, N m of the felt wrench: more than a usual sensor's noise, smoothed
_FASTER = 3e-3, 1e-3  # m/s of the tool, thrice what noise makes of one that stands, and m that it has gone on meanwhile
_YIELDS = 0.02  # m by which the softest fingers, of 3 kN/m, yield to the most force
ALLOWED, _SUSPECTED = 0.4, 0.2  # of max_force_n may be hidden, for as much comes until the arm stands; is suspected
_LASTS = 0.06  # s for which that must last: an arm that was jerked rings, and for half of that its inertia is a load
_AT_ONCE = 3  # readings of which the least is what a pull slows down for: one may be late
# Readings that must have differed before; how often as long as ever a sensor repeats itself when it is stuck, and for
# how long [s], while the setpoint moved by so much [m]: drivers send a reading again while the next is late, and what
# is coarse says the same as the arm stands
_DIFFERED, _AS_LONG, _STUCK, _STUCK_WAY = 100, 5, 0.1, 1e-3
_CREEP, _FREE = 0.01, 8e-3  # m/s for the first m, which no hand goes without what it holds
_MISSTATED, _CREEP_SHARE = 0.5, 0.2  # of a servo's lag may be misstated, and of the force hidden by it as it creeps
_UNTOLD = 0.5  # of the usual speed beyond that, until the force sensor has felt anything
_TOLD = 2.0  # N that tell that it does: ten times the noise of a usual one
_GOES_ON = 3e-3  # m that the tool goes on with it: as much as fingers yield to 60 N, which a jam tells as well


@dataclass(frozen=True)
class _Moment:
    """rows (n + 6, 5): speed, load, side, one and lead. felt (6,): the wrench. way: of the tool so far [m]."""

    stamp: float
    rows: Array
    felt: Array
    way: float
    J: Array

    def differs(self, felt: Array) -> bool:
        """Whether another wrench (6,) is felt than then."""
        change = felt - self.felt
        return bool(change[:3] @ change[:3] >= _CHANGED[0] ** 2 or change[3:] @ change[3:] >= _CHANGED[1] ** 2)


class Repetition:
    """stuck: whether the sensor repeats itself to the last digit for much longer than it ever did."""

    def __init__(self) -> None:
        self.same, self.longest, self.stuck = 1, 1, False
        self._raw, self._stamp, self._changed = b"", -math.inf, math.inf
        self._differed, self._way = 0, 0.0

    def hear(self, raw: Array, stamp: float) -> None:
        """Take a reading, as it came."""
        if stamp <= self._stamp:
            return
        self._stamp = stamp
        if raw.tobytes() != self._raw:
            if not self.stuck:  # one that was stuck and says something again has taught nothing of how it is when sound
                self.longest = max(self.longest, self.same)
            self._raw, self._changed, self.same, self._way, self.stuck = raw.tobytes(), stamp, 1, 0.0, False
            self._differed += 1
            return
        self.same += 1
        long = self.same > _AS_LONG * self.longest and stamp - self._changed >= _STUCK
        self.stuck = self._differed >= _DIFFERED and long and self._way >= _STUCK_WAY

    def moved(self, way: float) -> None:
        """The setpoint has moved by so much [m]."""
        self._way += way


class Observer:
    """Take every tick. hidden: force on the tool that is likely not felt [N]. told: whether the sensor has shown a
    force under which the tool moved on.
    """

    def __init__(self, task: ImpedanceTask, period: float, least: Array, judges: bool = True) -> None:
        """period: of references and readings [s]. least (n,): stiffness of each joint's servo at least [N m/rad], NaN
        where that is not known. judges: whether a sensor by which servos are softer is wrong.
        """
        self._stiff = task.mode == "admittance"  # else the stack holds the tool's axes, as softly as it is asked to
        along, across, turning = task.stiffness
        way, turn = task.stack if self._stiff else (min(along, across), turning)
        softest = np.where(np.isfinite(least), _STATED / least, _SOFTEST)
        yields = np.concatenate([softest, [1.0 / way] * 3, [1.0 / turn] * 3])
        # _yielded: of all moments, suspected ones as well: a sensor that tells a part of a jam is shown by it
        self.model, self._yielded = ServoModel(yields, task.servo_lag), ServoModel(yields, task.servo_lag)
        self.hidden, self.told = 0.0, False
        self._repetition = Repetition()
        self._task, self._period, self._n, self._least = task, period, len(least), least
        self._judged = judges and self._stiff and bool(np.isfinite(least).any())
        self._since = math.inf  # m of progress at which a force was felt first
        self._softness: tuple[int, tuple[float, float] | None] = -1, None  # with how many moments it was found
        self._late: deque[tuple[float, float]] = deque()  # when messages came late, and by how much [s]
        self._heard = math.inf
        self._sent: deque[tuple[float, Array]] = deque()
        self._tool = np.zeros(3)  # setpoint
        self._read: deque[tuple[float, Array, Array, Array, Array]] = deque()  # stamp, q, lead, wrench, load
        self._begun: Array | None = None
        # lead of the arm as it stood, wrench and load
        self._zero = np.zeros(len(least)), np.zeros(6), np.zeros(len(least))
        self._past: deque[tuple[_Moment, Array]] = deque()  # of the last lags, and by how much leads may have been more
        self._told_within = np.zeros(len(least) + 6)  # standard deviations of loads and wrench
        self._noted: _Moment | None = None
        self._waiting: deque[_Moment] = deque()
        self._way, self._suspected, self._evidence, self._looked = 0.0, -math.inf, 0.0, -math.inf
        self._lately: deque[float] = deque(maxlen=_AT_ONCE)

    @property
    def stiffest(self) -> float:
        """Stiffness [N/m] by which the tool is held at most, before any is learned."""
        return self._task.arm_stiffness if self._stiff else max(self._task.stiffness[:2])

    def restrict(self, task: ImpedanceTask) -> None:
        """Keep to the stiffness that another task states."""
        self._task = task

    def sent(self, q: Array, tool: Array, now: float) -> None:
        """Note the reference (n,) and the setpoint (3,) [m] that are sent at time ``now`` [s]."""
        if self._begun is None:
            self._begun, self._tool = q.copy(), tool.copy()
        self._repetition.moved(math.dist(tool, self._tool))
        self._tool = tool.copy()
        self._sent.append((now, q.copy()))
        while self._sent[0][0] < now - _REMEMBERED:
            self._sent.popleft()

    def hear(self, raw: Array, stamp: float) -> None:
        """Take a reading of what tells the force, as it came."""
        self._repetition.hear(raw, stamp)

    def take(self, joints: JointPositions, now: float, wrench: Array, J: Array, most: float,
             efforts: tuple[Array, Array] | None = None) -> None:  # fmt: skip
        """Look at joints now [s].

        wrench (6,): felt, on the tool in its axes. J (6, n): the tool's Jacobian in its axes. most: force that may
        come [N]. efforts: loads of the joints (n,), where more is known than −Jᵀ of the wrench, for their friction is
        in it; with standard deviations (n + 6,), of these and of the wrench.
        """
        q, stamp = joints.q, joints.stamp
        self._late.append((now, max(now - stamp, now - self._heard - self._period, 0.0)))
        while self._late[0][0] < now - _REMEMBERED:
            self._late.popleft()
        self._heard = now
        reference = self._reference(stamp)
        if reference is None or self._begun is None or (self._read and stamp <= self._read[-1][0]):
            return
        lead, load = reference - q, -J.T @ wrench if efforts is None else efforts[0]
        self._told_within = np.zeros(self._n + 6) if efforts is None else efforts[1]
        if np.abs(reference - self._begun).max() <= _SETTLES:
            self._zero = lead, wrench, load
        lead, wrench, load = (x - zero for x, zero in zip((lead, wrench, load), self._zero, strict=True))
        self._read.append((stamp, q.copy(), lead, wrench, load))
        while len(self._read) > 2 and self._read[0][0] < stamp - _MEAN - 1e-6:
            self._read.popleft()
        if len(self._read) < 2:
            return
        older = self._reference(stamp - max(late for _, late in self._late))
        at = self._moment(_SPAN, J)
        v = at.rows[self._n : self._n + 3, 0]
        self._way += math.sqrt(v @ v) * (stamp - self._read[-2][0])
        self._judge(at, np.zeros(len(q)) if older is None else older - reference, most)
        self._learn(at)

    def _reference(self, stamp: float) -> Array | None:
        """The newest reference (n,) that was sent by then [s]; None where none was."""
        return next((r for t, r in reversed(self._sent) if t <= stamp), None)

    def _moment(self, span: float, J: Array) -> _Moment:
        """The last reading with the mean speed over a span [s]; the mean of all, over the longest."""
        stamp, q, lead, wrench, load = self._read[-1]
        first = next(one for one in self._read if one[0] >= stamp - span - 1e-6 or one is self._read[-2])
        if span == _MEAN:
            lead, wrench, load = (np.mean(values, axis=0) for values in list(zip(*self._read, strict=True))[2:])
        speed = (q - first[1]) / (stamp - first[0])
        pairs = ((speed, J @ speed), (load, -wrench), (lead, J @ lead))
        return _Moment(stamp, self.model.rows(*map(np.concatenate, pairs)), wrench, self._way, J)

    def _judge(self, at: _Moment, by: Array, most: float) -> None:
        """See what is hidden. by (n,): by how much more references lead that may still be in effect."""
        model, by = self.model, np.concatenate([by, at.J @ by])
        self._past.append((at, by))
        while self._past[0][0].stamp < at.stamp - _RECALL * self._task.servo_lag:
            self._past.popleft()
        then, by_then = self._past[0]
        joints, axes = (True, False) if self._judged else model.held if self._stiff else (False, True)
        held = [by_axes for by_axes, so in ((False, joints), (True, axes)) if so]
        found, none = [], np.zeros_like(by)
        told = (np.abs(model.x[:, 1]) + model.unsure) * self._told_within
        # what the leads have come to, and by how much they have changed of late: a sensor that falls silent before it
        # is known what servos yield is told by that
        changes = [none, by, -by_then, by - by_then]
        for base, late in ((np.zeros_like(at.rows), changes[:2]), (then.rows, changes)):
            spread = np.hypot(model.spread(at.rows[:, :4] - base[:, :4]), told)
            left = self._unexplained(at.rows - base, base[:, 1], np.array(late))
            load = at.rows[:, 1] - base[:, 1]
            found.append(min(model.force(left, spread, load, at.J, by_axes, self.stiffest) for by_axes in held))
        self._lately.append(max(found))
        self.hidden = min(self._lately)
        if self.hidden > _SUSPECTED * most:
            self._suspected = at.stamp

    def _unexplained(self, rows: Array, base: Array, by: Array) -> Array:
        """The lead (n + 6,) of every row that neither its speed nor its load explains.

        base (n + 6,): load to begin with. by (k, n + 6): by how much more the lead may be.
        """
        x = self.model.x
        lead = rows[:, 4] - (rows[:, [0, 2, 3]] * x[:, [0, 2, 3]]).sum(axis=1)
        takes = x[:, 1] * (np.array([one.rows[:, 1] for one, _ in self._past]) - base)
        ahead = lead + by.min(axis=0) - np.maximum(takes.max(axis=0), 0.0)
        behind = np.minimum(takes.min(axis=0), 0.0) - lead - by.max(axis=0)
        return np.asarray(np.maximum(ahead, 0.0) - np.maximum(behind, 0.0))

    def _learn(self, at: _Moment) -> None:
        """Note the mean of now, if it tells something new; learn what was noted before and is trusted by now."""
        v, noted = at.rows[self._n : self._n + 3, 0], self._noted
        goes_on = noted is not None and at.way - noted.way >= _FASTER[1] and math.sqrt(v @ v) >= _FASTER[0]
        if noted is None or goes_on or noted.differs(at.felt):
            mean = self._moment(_MEAN, at.J)
            if noted is None or goes_on or noted.differs(mean.felt):
                self._noted = mean
                self._waiting.append(mean)
                if self._judged:
                    self._yielded.learn(mean.rows, mean.J)
                    self._yielded.solve()
        learned = False
        while self._waiting and self._waiting[0].stamp < at.stamp - _DELAY:
            first = self._waiting[0]
            if self._suspected < first.stamp:
                if not (first.differs(at.felt) or at.way - first.way >= _YIELDS):
                    break
                self.model.learn(first.rows, first.J)
                learned = True
            self._waiting.popleft()
        if learned:
            self.model.solve()

    def stiffness(self, way: Array, J: Array) -> float:
        """Stiffness [N/m] by which the servos hold the tool at most along a way (3,). J (6, n): the tool's Jacobian."""
        axes = not (self._judged or self.model.held[0])
        return self.model.stiffness(way, J, axes, self.stiffest) if self.model.known else self.stiffest

    def softness(self) -> tuple[float, float] | None:
        """Compliance of the joints as a share of what it is at most, and its standard deviation; None while unknown."""
        if self._judged and self._softness[0] != self._yielded.count and self._noted is not None:
            self._softness = self._yielded.count, self._yielded.softness(self._noted.J, self._least)
        return self._softness[1]

    @property
    def said(self) -> str:
        """What the servos yield, as text; empty while that is not known."""
        if (softness := self.softness()) is None:
            return ""
        return f"{softness[0]:.2f} of max_joint_lead_rad, within {_LIKELY * softness[1]:.2f}"

    def refused(self, felt: float, apart: float, stamp: float, most: float) -> BadCommand | None:
        """Why to let go, or None.

        felt: force that is told [N]. apart: by how much the efforts surely show another one [N]. most: that may come
        [N].
        """
        dt = min(max(stamp - self._looked, 0.0), _LASTS / _AT_ONCE)
        self._looked = stamp
        beyond = max(self.hidden, apart) > ALLOWED * most
        self._evidence = max(self._evidence + (dt if beyond else -dt), 0.0)
        same, softness, said = self._repetition, self.softness(), ""
        if same.stuck:
            said = f"says {felt:.0f} N to the last digit, {same.same} times in a row, at most {same.longest} before"
        elif softness is not None and softness[0] - _SURE * softness[1] > _STATED:
            said = f"says forces by which the joints yield {softness[0]:.1f} times as much as max_joint_lead_rad allows"
        elif self._evidence >= _LASTS and beyond and apart >= self.hidden:
            said = f"says {felt:.0f} N, and the efforts of the joints surely show {apart:.0f} N more or less"
        elif self._evidence >= _LASTS and beyond:
            said = f"says {felt:.0f} N, but the setpoint leads the tool as if {self.hidden:.0f} N more were on it"
        return (
            BadCommand("wrench", f"the force sensor {said}", "check it, servo_lag_s and what is stated of joints")
            if said
            else None
        )

    def note(self, force: float, progress: float) -> None:
        """Note a felt force [N] with the tool so far [m] on its way."""
        self._since = min(self._since, progress) if force >= _TOLD else math.inf
        self.told = self.told or progress - self._since >= _GOES_ON

    def speed(self, progress: float, known: bool, most: float) -> float:
        """The speed [m/s] at which to go on, with the tool so far [m] from where it began. known: whether the path is.

        A force sensor that has not told of anything may be stuck, and so may one that told of little: until the hand
        has come some way, and until the sensor has told, little may come of that; and a known path is followed as an
        unknown one until servos and sensor agree. most: force that may come [N].
        """
        task, hides = self._task, _MISSTATED * self._task.servo_lag * self.stiffest
        creep = min(_CREEP, _CREEP_SHARE * most / max(hides, 1e-9))  # at which what a misstated lag hides is little
        usual = task.exploration_speed
        if known:
            softness = self.softness()
            agrees = not self._judged if softness is None else softness[0] + _LIKELY * softness[1] <= 1.0
            return task.speed if self.told and agrees else min(task.speed, usual * creep / _CREEP)
        if progress < _FREE:
            return min(usual, creep)
        return usual if self.told else min(usual, max(creep, _UNTOLD * usual * creep / _CREEP))

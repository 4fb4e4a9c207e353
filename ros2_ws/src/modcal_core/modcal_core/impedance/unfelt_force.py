"""The force on the tool that the servos' leads show, beyond the one that is felt.

What the lag and the compliance of the servos (:mod:`~modcal_core.impedance.servo_model`) do not explain of a lead is a
load that is not felt. Of all rows together it is a wrench on the tool, found by least squares; a row that was hardly
loaded, or does not behave so, has a large uncertainty and counts for little. Where both stacks explain what was seen,
the one that shows less force is believed.

A model is never exact, and a sensor that follows must not be taken for one that does not. So what counts is how much
the hidden force has *grown* within half a second while the felt one stood still: a sensor that follows shows that by
what it says, however wrong the model. What counts so slows the pull down as a felt force does
(:meth:`UnfeltForce.take`); the pull is let go where it stays (:meth:`UnfeltForce.refused`).

What is learned must not explain a jam. So a moment is learned only after a while in which nothing was suspected, and
only where the felt wrench or the speed has changed since the last one: a sensor that has frozen teaches nothing,
however long the lead grows.

Which reference a servo followed at the time of a reading is known as well as messages come in time. As late as they
came of late, an older reference may have been in effect. A pull slows down for what one of them shows, and is let go
for what both do: a setpoint that stands leaves no doubt.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from modcal_core.errors import BadCommand
from modcal_core.geometry.so3 import Array
from modcal_core.impedance.servo_model import FEWEST, ServoModel

_SPAN = 0.012  # s over which a joint's speed is measured: three readings at 250 Hz
_MEAN = 0.04  # s over which what is learned is averaged: noise is a third of what it is in one reading
_REMEMBERED = 0.5  # s of references
_SETTLES = 3e-4  # rad or m that a reference has gone, up to which the lead is how the arm sags, and no force
_DELAY = 0.25  # s after which a moment is learned: a jam is suspected within a tenth of that
_CHANGED = 0.5, 0.05  # N, N m of the felt wrench: more than a usual sensor's noise, smoothed
_FASTER = 5e-3  # m/s of the tool: a sixth of the speed of exploration
_SOFTEST = 1e-3  # rad/N m, m/N or rad/N: a compliance may be as large before it is learned
_SURE = 2.0  # standard deviations of a compliance from zero, below which it counts for nothing
_DEVIATIONS = 2.0  # by which the force that is not felt is taken to be smaller than it seems
_FORCE, _MOMENT = 100.0, 5.0  # N, N m: how large it may be where rows that count for nothing would have to show it
_GROWTH = 0.5  # s within which a hidden force grows: a jam is met by a setpoint that goes on, not by one that creeps
_MOVED_ON = 5e-3  # m: a tool that went on by as much was not held; then the model is wrong, in this posture
_SHARE = 0.5  # of a change of the felt wrench that may be hidden beside it, for the model is wrong by as much at most
_MOST = 0.4  # of max_force_n may go unfelt, for as much again comes until the arm stands
_SUSPECTED = 0.2  # of it: from there on nothing is learned
_FORGETS = 0.98  # of what the models' errors were, with every moment
_WORSE = 2.0  # times the error of the other model: then it is the other one
_EXACT = 5e-5  # m: errors that differ by less do not tell
_IN_A_ROW = 2  # readings, for one may be late


@dataclass(frozen=True)
class _Moment:
    """speed, load, lead: (m,) of the rows. wrench (6,): felt. J (6, n)."""

    stamp: float
    speed: Array
    load: Array
    lead: Array
    J: Array


class UnfeltForce:
    """Take every tick; ``force`` [N] is what grew without being felt, ``sure`` [N] as much of it as is certain."""

    def __init__(self, joints: int, lag: float, period: float) -> None:
        """For a number of joints whose servos lag by about so much, with a reference every period [s]."""
        self.period = period
        self.model = ServoModel(np.full(joints + 6, _SOFTEST), lag)
        self.force = self.sure = 0.0
        self._n = joints
        self._late: deque[tuple[float, float]] = deque()  # when, and by how much [s]
        self._sent: deque[tuple[float, Array]] = deque()
        self._read: deque[tuple[float, Array, Array, Array]] = deque()  # stamp, q, lead, wrench
        self._begun: Array | None = None
        self._zero = np.zeros(joints), np.zeros(6)  # lead of the arm as it stood, and wrench
        self._noted: tuple[Array, Array] | None = None  # felt wrench, and twist of the tool
        self._waiting: deque[_Moment] = deque()
        self._errors = np.zeros(2)  # m², of the joints' rows and of the tool's
        self._weight = 0.0
        self._past: deque[tuple[float, float, Array, Array]] = deque()  # stamp, way [m], hidden [N], felt (3,)
        self._way = 0.0  # m that the tool has gone
        self._suspected = -math.inf
        self._beyond = 0

    def sent(self, q: Array, now: float) -> None:
        """Note the reference (n,) that is sent at time ``now`` [s]."""
        self._begun = q.copy() if self._begun is None else self._begun
        self._sent.append((now, q.copy()))
        while self._sent[0][0] < now - _REMEMBERED:
            self._sent.popleft()

    def refused(self, wrench: Array, most: float) -> BadCommand | None:
        """Why to let go: too much of ``most`` [N] is surely not felt; None where all is well."""
        if self._beyond < _IN_A_ROW:
            return None
        felt = math.sqrt(wrench[:3] @ wrench[:3])
        said = f"{felt:.0f} N are felt but the setpoint leads the tool as if {self.sure:.0f} N more were on it"
        return BadCommand("wrench", said, "check the force sensor")

    def take(self, q: Array, stamp: float, now: float, wrench: Array, J: Array, most: float) -> None:
        """Look at joints q (n,) of ``stamp`` [s], now [s].

        wrench (6,): felt, on the tool in its axes. J (6, n): the tool's Jacobian in its axes. most: force that may
        come [N].
        """
        before = self._late[-1][0] if self._late else now - self.period
        self._late.append((now, max(now - stamp, now - before - self.period, 0.0)))
        while self._late[0][0] < now - _REMEMBERED:
            self._late.popleft()
        reference = self._reference(stamp)
        if reference is None or (self._read and stamp <= self._read[-1][0]):
            return
        lead = reference - q
        if self._begun is not None and np.abs(reference - self._begun).max() <= _SETTLES and not self.model.count:
            self._zero = lead, wrench
        self._read.append((stamp, q.copy(), lead - self._zero[0], wrench - self._zero[1]))
        while len(self._read) > 2 and self._read[0][0] < stamp - _MEAN - 1e-6:
            self._read.popleft()
        if len(self._read) < 2:
            return
        older = self._reference(stamp - max((by for _, by in self._late), default=0.0))
        self._judge(stamp, None if older is None else older - reference, J, most)
        self._note(J)
        self._learn(stamp)

    def _reference(self, stamp: float) -> Array | None:
        """The newest reference (n,) that was sent by then [s]; None where none was."""
        return next((r for t, r in reversed(self._sent) if t <= stamp), None)

    def _moment(self, since: float, J: Array, mean: bool) -> _Moment:
        """The readings since then as one: the last one, or their mean, with their mean speed."""
        stamp, q, lead, wrench = self._read[-1]
        lately = [one for one in self._read if one[0] >= since - 1e-6]
        first = lately[0] if len(lately) > 1 else self._read[-2]
        if mean:
            lead = np.mean([e for _, _, e, _ in lately], axis=0)
            wrench = np.mean([w for *_, w in lately], axis=0)
        speed = (q - first[1]) / (stamp - first[0])
        load = np.concatenate([-J.T @ wrench, -wrench])
        return _Moment(stamp, np.concatenate([speed, J @ speed]), load, np.concatenate([lead, J @ lead]), J)

    def _judge(self, stamp: float, by: Array | None, J: Array, most: float) -> None:
        """What is hidden, if the newest reference is in effect and if one is that leads by more (n,)."""
        at, felt = self._moment(stamp - _SPAN, J, mean=False), self._read[-1][3][:3]
        leads = at.lead[:, None]
        if by is not None:
            leads = np.stack([at.lead, at.lead + np.concatenate([by, J @ by])], axis=1)
        hidden = self._hidden(at, leads)
        grown = np.zeros(len(hidden))
        for _, _, then, said in self._past:
            away = felt - said
            grown = np.maximum(grown, hidden - then[: len(hidden)] - _SHARE * math.sqrt(away @ away))
        self.force, self.sure = float(grown[0]), float(grown.min())
        v = at.speed[self._n : self._n + 3]
        self._way += math.sqrt(v @ v) * (stamp - self._read[-2][0])
        suspected = bool(grown.max() > _SUSPECTED * most)
        if suspected:
            self._suspected = stamp
        else:
            self._past.append((stamp, self._way, np.array([hidden[0], hidden[-1]]), felt))
        while len(self._past) > 1 and self._past[0][0] < stamp - _GROWTH:
            if suspected and self._way - self._past[0][1] <= _MOVED_ON:  # of what is suspected the beginning is kept
                break
            self._past.popleft()
        self._beyond = self._beyond + 1 if self.sure > _MOST * most else 0

    def _hidden(self, at: _Moment, leads: Array) -> Array:
        """The forces (k,) [N] that are not felt, at least, for leads (m, k) of the rows."""
        if self.model.count < FEWEST:
            return np.zeros(leads.shape[1])
        left = leads - self.model.predicted(at.speed, at.load)[:, None]
        spread, compliance = self.model.spread(at.speed, at.load), self.model.compliance(_SURE)
        errors = np.sqrt(self._errors / max(self._weight, 1e-9)) + _EXACT
        n, shown = self._n, np.full(leads.shape[1], math.inf)
        for rows, L, error in ((slice(0, n), at.J, errors[0]), (slice(n, n + 6), np.eye(6), errors[1])):
            if error <= _WORSE * errors.min():
                shown = np.minimum(shown, _force(left[rows], spread[rows], compliance[rows], L))
        return shown

    def _note(self, J: Array) -> None:
        """Have a moment learned later, if it differs from the one before."""
        moment = self._moment(-math.inf, J, mean=True)
        n = self._n
        felt, twist = -moment.load[n:], moment.speed[n:]
        if self._noted is not None:
            off, faster = felt - self._noted[0], (twist - self._noted[1])[:3]
            sizes = math.sqrt(off[:3] @ off[:3]), math.sqrt(off[3:] @ off[3:]), math.sqrt(faster @ faster)
            if sizes[0] < _CHANGED[0] and sizes[1] < _CHANGED[1] and sizes[2] < _FASTER:
                return
        self._noted = felt, twist
        self._waiting.append(moment)

    def _learn(self, now: float) -> None:
        """Learn what was noted long enough ago, unless something was suspected since."""
        learned, n = False, self._n
        while self._waiting and self._waiting[0].stamp < now - _DELAY:
            at = self._waiting.popleft()
            if self._suspected >= at.stamp:
                continue
            if self.model.count >= FEWEST:
                left = at.lead - self.model.predicted(at.speed, at.load)
                joints = at.J[:3] @ left[:n]
                self._errors = _FORGETS * self._errors + (joints @ joints, left[n : n + 3] @ left[n : n + 3])
                self._weight = _FORGETS * self._weight + 1.0
            self.model.learn(at.speed, at.load, at.lead)
            learned = True
        if learned:
            self.model.solve()


def _force(left: Array, spread: Array, compliance: Array, L: Array) -> Array:
    """The forces (k,) [N] that rows show by what is left of their leads (m, k), at least. L (6, m): their levers."""
    A = -(compliance / spread)[:, None] * L.T  # (m, 6)
    P = np.linalg.inv(A.T @ A + np.diag([_FORCE**-2.0] * 3 + [_MOMENT**-2.0] * 3))
    shown = (P @ A.T)[:3]  # (3, m): the smallest wrench that shows as these leads; a larger one may
    f = shown @ (left / spread[:, None])  # (3, k)
    size = np.sqrt((f * f).sum(axis=0))
    along = f.T @ shown  # (k, m)
    return np.asarray(np.maximum(size - _DEVIATIONS * np.sqrt((along**2).sum(axis=1)) / np.maximum(size, 1e-9), 0.0))

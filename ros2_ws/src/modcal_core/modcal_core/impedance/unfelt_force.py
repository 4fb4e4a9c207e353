"""The force on the tool that the servos' leads show, beyond the one that is felt.

A servo's reference leads what it moves by e = l v + c τ + b, with its lag l [s], the measured speed v, its compliance
c, the load τ that it carries and a small rest b. Every row of a model is such a servo; its numbers are learned while
the force sensor follows, by linear least squares with a prior, and with the variance of what they leave.

Which stack holds the tool is not told. One that is stiff in its joints is a row a joint, whose load is −Jᵀ w of the
felt wrench w; one that is stiff in the tool's axes is a row an axis, whose load is −w. Both are learned; the one that
predicts the tool's lead better is believed, and where both do, the one that shows less force says what is sure.

What lag and compliance do not explain of a lead is a load that is not felt: of all rows together a wrench, by least
squares, in which rows that are hardly known count for little. A model is never exact, so the leads of now are compared
with those of the last centimetre or two, where the same errors were made, and less is taken to be hidden by what the
felt force has changed meanwhile. What is hidden slows the pull down (:attr:`UnfeltForce.force`) and ends it where it is
much (:meth:`UnfeltForce.refused`).

What is learned must not explain a jam. So a moment is learned only after a while in which nothing was suspected, and
only where the felt wrench, or the speed of a tool that goes on, has changed since the last one.
Messages come late: a pull slows down for what the newest reference or an older one shows, and is let go for both.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from modcal_core.errors import BadCommand
from modcal_core.geometry import Array
from modcal_core.impedance.lead_check import SentReferences
from modcal_core.impedance.task import JointPositions

_ALIKE = 4.0  # neighbouring moments that depart from the model alike: so much fewer they count
FEWEST = 4  # moments from which three numbers are learned
FLOOR = 2e-5  # rad or m: encoders; what is left of what was learned is as large or larger
_LAG_UNKNOWN = 0.5  # of the stated lag, by which that of a servo may differ before it is learned
_REST = 1e-4  # rad or m: what dry friction leaves in a lead as the arm stands


class ServoModel:
    """Rows e = l v + c τ + b. compliance (m,): 0 where none stands out. unsure_by (m,): its standard deviation."""

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


_SPAN = 0.012  # s over which a joint's speed is measured: three readings at 250 Hz
_MEAN = 0.04  # s over which what is learned is averaged: noise is a third of what it is in one reading
_SETTLES = 3e-4  # rad or m that a reference has gone, up to which the lead is how the arm sags, and no force
_DELAY = 0.25  # s after which a moment is learned: a jam is suspected within a tenth of that
_CHANGED = 0.5, 0.05  # N, N m of the felt wrench: more than a usual sensor's noise, smoothed
_NEARLY = 0.5  # of that, by which a single reading must differ before a mean is looked at
_FASTER = 5e-3, 1e-3  # m/s of the tool, a sixth of the speed of exploration, and m that it has gone on meanwhile
_SOFTEST = 1e-3  # rad/N m, m/N or rad/N: a compliance may be as large before it is learned
_SURE = 2.0  # standard deviations by which a force must stand out, and is taken to be smaller than it seems to let go
# N, N m: how large it may be where nothing shows it; a hand holds a handle some centimetres off its middle at most
_PRIOR = np.diag([200.0**-2.0] * 3 + [3.0**-2.0] * 3)
_STANDS_OUT = 3.0  # standard deviations: where no row departs by more nothing is hidden
_PASSES = 3  # in which rows whose compliance is unsure come to count by how large a load is hidden
_SETTLED = 0.04  # s after which leads are such as those of now are compared with
# m of the tool's way on which they lie: half a second of exploration; of an arm that stands, none is new
_BEFORE = 0.015
_STEP = 3e-4  # m from one to the next: fifty, of which a mean and a scatter are known to a tenth
_MIN = 10  # of them
# m: a tool that went on by as much was not held, for fingers yield half of it to 60 N; then the model is wrong
_MOVED_ON = 8e-3
# m: by then the leads that are compared, of the last 15 mm, are of a hand that goes on and takes up no load any more
_TRAVELLED = 0.03
_SHARE = 1.0  # of a change of the felt force that is not believed to be hidden beside it: what is learned of a servo
# that yields by half as much as it does would show that
_MAX = 0.4  # of max_force_n may go unfelt, for as much again comes until the arm stands
# N that a lead must take on the softest servos beyond what is felt, for a sensor not to answer it: ten times the noise
# of a mean of so many readings
_ANSWERS, _AVERAGED = 1.5, 5
_RECALL = 3.0  # servo lags for which a force that has gone still explains a lead: a servo unwinds by its lag
_SUSPECTED = 0.2  # of it: from there on nothing is learned
_FORGETS = 0.98  # of what the models' errors were, with every moment
_WORSE = 1.5  # times the error of the other model: then it is the other one
_RINGS = 0.06  # s for which that must last: an arm that was jerked rings, and for half of that its inertia is a load
_AT_ONCE = 3  # readings of which the least is what a pull slows down for: one may be late
_STAYS = 0.4  # s for which as much is likely: ten lags of a servo, in which what is no force has gone


@dataclass(frozen=True)
class _Moment:
    """rows (m, 4): speed, load, one and lead. felt (3,): force. way: that the tool has gone so far [m]. J (6, n)."""

    stamp: float
    rows: Array
    felt: Array
    way: float
    J: Array


class UnfeltForce:
    """Force [N] that leads show and the sensor does not. sure: what late messages cannot explain. Call every tick."""

    def __init__(self, joints: int, lag: float, period: float, stiffest: float = 100e3) -> None:
        """For a number of joints whose servos lag by about so much, with a reference every period [s].

        stiffest: by which they may hold the tool [N/m].
        """
        self.stiffest, self._references = stiffest, SentReferences(period)
        self.model = ServoModel(np.full(joints + 6, _SOFTEST), lag)
        self.force = self.sure = 0.0
        self._n = joints
        self._read: deque[tuple[float, Array, Array, Array, Array]] = deque()  # stamp, q, lead, wrench, load
        self._zero = np.zeros(joints), np.zeros(6), np.zeros(joints)  # lead of the arm as it stood, wrench and load
        self._noted: _Moment | None = None
        self._waiting: deque[_Moment] = deque()
        self._learned = False
        self._felt: deque[_Moment] = deque()  # of the last lags
        self._recalled = _RECALL * lag
        self._errors = np.zeros(2)  # m², of the joints' rows and of the tool's
        self._before = _MomentWindow(joints + 6)
        self._compared = (0, 0)  # how often there was a new one, of the leads before and of the model
        self._base = np.zeros((joints + 6, 4)), np.zeros(3), np.zeros(joints + 6)
        self._recent: deque[_Moment] = deque()  # too new to be compared with
        self._way = 0.0
        self._softness: tuple[int, tuple[float, float] | None] = -1, None  # with how many moments it was found
        self._suspected = -math.inf
        self._likely: deque[float] = deque(maxlen=_AT_ONCE)
        self._sure_since, self._lasts = math.inf, False
        self._little = math.inf  # s, when little was hidden

    @property
    def servos(self) -> tuple[Array, Array, Array] | None:
        """Servo lags (n,) [s], their deviations (n,) [s] and leads at rest (n,) [rad]; None before any are learned."""
        if self.model.count < FEWEST:
            return None
        n, model = self._n, self.model
        return model.lag[:n], model.lag_unsure_by[:n], model.rest[:n]

    def softness(self, least: Array) -> tuple[float, float] | None:
        """By how much the joints' servos yield to the felt force, as a share of what they may at most, and its standard
        deviation; None where nothing is learned or known, or where the tool is held in its own axes.

        least (n,): stiffness of each servo at least [N m/rad], NaN where that is not known.
        """
        model, last = self.model, self._noted
        if self._softness[0] == model.count:
            return self._softness[1]
        found = None
        if model.count >= FEWEST and last is not None and not self._errors[0] > _WORSE**2 * self._errors[1] > 0.0:
            found = model.softness(np.sqrt((last.J[:3] ** 2).sum(axis=0)), least)
        self._softness = model.count, found
        return found

    def stiffness(self, way: Array, J: Array, stated: float) -> float:
        """Stiffness [N/m] by which the servos hold the tool at most along a way (3,), and no more than is stated.

        J (6, n): the tool's Jacobian in its axes, as the way.
        """
        model, n = self.model, self._n
        if model.count < FEWEST:
            return stated
        in_axes = self._errors[0] > _WORSE**2 * self._errors[1] > 0.0
        levers, rows = (way, slice(n, n + 3)) if in_axes else (J[:3].T @ way, slice(0, n))
        yields = levers * levers @ np.stack([model.compliance, model.unsure_by])[:, rows].T
        least = max(float(yields[0] - _SURE * yields[1]), 1e-9)
        return min(1.0 / least, stated)

    def sent(self, q: Array, now: float) -> None:
        """Note the reference (n,) that is sent at time ``now`` [s]."""
        self._references.sent(q, now)

    def refused(self, wrench: Array, most: float) -> BadCommand | None:
        """Why to let go: too much of ``most`` [N] is surely not felt; None where all is well."""
        if not self._lasts:
            return None
        felt = math.sqrt(wrench[:3] @ wrench[:3])
        said = f"{felt:.0f} N are felt but the setpoint leads the tool as if {self.sure:.0f} N more were on it"
        return BadCommand("wrench", said, "check the force sensor")

    def take(
        self, joints: JointPositions, now: float, wrench: Array, J: Array, most: float, load: Array | None = None
    ) -> None:
        """Look at joints now [s].

        wrench (6,): felt, on the tool in its axes. J (6, n): the tool's Jacobian in its axes. most: force that may
        come [N]. load (n,): of the joints, where more is known than −Jᵀ of the wrench: their friction is in it.
        """
        q, stamp = joints.q, joints.stamp
        load = -J.T @ wrench if load is None else load
        sent = self._references
        sent.heard(stamp, now)
        reference = sent.newest(stamp)
        if reference is None or (self._read and stamp <= self._read[-1][0]):
            return
        lead = reference - q
        if sent.begun is not None and np.abs(reference - sent.begun).max() <= _SETTLES and not self.model.count:
            self._zero = lead, wrench, load
        lead, wrench, load = (x - zero for x, zero in zip((lead, wrench, load), self._zero, strict=True))
        self._read.append((stamp, q.copy(), lead, wrench, load))
        while len(self._read) > 2 and self._read[0][0] < stamp - _MEAN - 1e-6:
            self._read.popleft()
        if len(self._read) < 2:
            return
        older = sent.newest(stamp - sent.late) if sent.late > 0.0 else None
        at = self._moment(stamp - _SPAN, J)
        v = at.rows[self._n : self._n + 3, 0]
        self._way += math.sqrt(v @ v) * (stamp - self._read[-2][0])
        self._learned = self._learn(stamp) and not self._learned
        if not self._learned:  # both together would take too long for a tick
            self._judge(at, None if older is None else older - reference, most)
        if self._differs(at, _NEARLY):  # before the mean is taken, which costs more
            mean = self._moment(-math.inf, J)
            if self._differs(mean):
                self._noted = mean
                self._waiting.append(mean)

    def _moment(self, since: float, J: Array) -> _Moment:
        """The last reading, with the mean speed since then [s]; the mean of all, where that is before them."""
        stamp, q, lead, wrench, load = self._read[-1]
        lately = [one for one in self._read if one[0] >= since - 1e-6]
        first = lately[0] if len(lately) > 1 else self._read[-2]
        if not math.isfinite(since):
            lead, wrench, load = (np.mean(values, axis=0) for values in list(zip(*lately, strict=True))[2:])
        speed = (q - first[1]) / (stamp - first[0])
        n = self._n
        rows = np.empty((n + 6, 4))
        rows[:n, 0], rows[n:, 0] = speed, J @ speed
        rows[:n, 1], rows[n:, 1] = load, -wrench
        rows[:, 2] = 1.0
        rows[:n, 3], rows[n:, 3] = lead, J @ lead
        return _Moment(stamp, rows, wrench[:3], self._way, J)

    def _judge(self, at: _Moment, by: Array | None, most: float) -> None:
        """What is hidden, if the newest reference is in effect and if one is that leads by more (n,)."""
        self._felt.append(at)
        while self._felt[0].stamp < at.stamp - self._recalled:
            self._felt.popleft()
        maybe, likely, self.sure = self._hidden(at, by)
        self._likely.append(likely)
        self.force = min(self._likely)
        if self.sure <= _MAX * most:
            self._sure_since = math.inf
        elif math.isinf(self._sure_since):
            self._sure_since = at.stamp
        if likely <= _MAX * most:
            self._little = at.stamp
        stays = at.stamp - self._little > _STAYS
        self._lasts = at.stamp - self._sure_since >= _RINGS or stays
        if stays:
            self.sure = max(self.sure, likely)
        self._recent.append(at)
        if maybe > _SUSPECTED * most:  # what it is compared with stays, unless the tool goes on
            self._suspected = at.stamp
            self._recent.clear()
            if self._before.count and self._way - self._before.last.way > _MOVED_ON:
                self._before.clear()
                self._little = at.stamp
            return
        while self._recent and self._recent[0].stamp <= at.stamp - _SETTLED:
            self._before.add(self._recent.popleft())

    def _hidden(self, at: _Moment, by: Array | None) -> tuple[float, float, float]:
        """The force [N] that may not be felt; that likely is not; and that surely is not, by an older reference too."""
        model, before, n = self.model, self._before, self._n
        if model.count < FEWEST or before.count < _MIN:
            return 0.0, 0.0, 0.0
        if self._compared != (key := (before.added, model.count)):
            mean, squares, felt = before.means()
            self._compared, self._base = key, (mean, felt, model.scatter(squares, mean) + FLOOR**2)
        mean, felt, variance = self._base
        change = at.rows - mean
        alone = model.left(change)  # what is the same of both is no change
        spread = np.sqrt(variance + model.unsure(change))
        if (np.abs(alone) < _STANDS_OUT * spread).all():
            return 0.0, 0.0, 0.0
        left = alone[:, None]
        if by is not None:
            left = np.stack([alone, alone + np.concatenate([by, at.J @ by])], axis=1)
        errors = np.sqrt(self._errors) + FLOOR
        maybe, likely, sure = 0.0, 0.0, math.inf
        followed = _SHARE * max(math.dist(one.felt, felt) for one in self._felt)
        some = np.array([one.felt for one in self._felt])
        first, last = some[:_AVERAGED].mean(axis=0), some[-_AVERAGED:].mean(axis=0)
        since = model.left(at.rows - self._felt[0].rows)
        older = np.zeros(len(at.rows)) if by is None else np.concatenate([by, at.J @ by])
        silent = max(
            min(self._silent(at, leads + late, spread, math.dist(last, then)) for late in (0.0, older))
            for leads, then in ((alone, felt), (since, first))
        )
        for rows, L, error in ((slice(0, n), at.J, errors[0]), (slice(n, n + 6), np.eye(6), errors[1])):
            if error <= _WORSE * errors.min():
                known = model.compliance[rows], model.unsure_by[rows]
                size, least = _force(left[rows], spread[rows], *known, L, self._way > _TRAVELLED)
                sure = min(sure, float(least.min()))
                if error == errors.min():
                    maybe = max(float(size[0]) - followed, 0.0)
                    likely = maybe if least[0] > 0.0 else 0.0
        return max(maybe, silent), max(likely, silent), max(sure - followed, silent)

    def _silent(self, at: _Moment, left: Array, spread: Array, followed: float) -> float:
        """The force [N] that may be hidden by a sensor that has not changed as much as a lead surely takes; else 0.

        left, spread (m,): what is left of the leads, and its deviation. followed: change of the felt force [N].
        """
        model, n = self.model, self._n
        way = at.J[:3] @ left[:n]
        far = math.sqrt(way @ way)
        levers = (at.J[:3].T @ way / max(far, 1e-9)) ** 2
        softest = float(levers @ (model.compliance + _SURE * model.unsure_by)[:n])
        unsure = math.sqrt(float(levers @ spread[:n] ** 2))
        if far < _STANDS_OUT * unsure or (far - _SURE * unsure) / softest - followed < _ANSWERS:
            return 0.0
        return max(far * self.stiffest - followed, 0.0)

    def _differs(self, moment: _Moment, share: float = 1.0) -> bool:
        """Whether a moment tells something that the last one which was noted does not. share: of what differs."""
        if self._noted is None:
            return True
        speed, load = (moment.rows[self._n :, :2] - self._noted.rows[self._n :, :2]).T
        if (
            math.sqrt(load[:3] @ load[:3]) >= share * _CHANGED[0]
            or math.sqrt(load[3:] @ load[3:]) >= share * _CHANGED[1]
        ):
            return True
        return self._way - self._noted.way >= _FASTER[1] and math.sqrt(speed[:3] @ speed[:3]) >= share * _FASTER[0]

    def _learn(self, now: float) -> bool:
        """Learn what was noted long enough ago, unless something was suspected since; whether there was anything."""
        learned, n = False, self._n
        while self._waiting and self._waiting[0].stamp < now - _DELAY:
            at = self._waiting.popleft()
            if self._suspected >= at.stamp:
                continue
            if self.model.count >= FEWEST:
                left = self.model.left(at.rows)
                joints = at.J[:3] @ left[:n]
                squares = np.array([joints @ joints, left[n : n + 3] @ left[n : n + 3]])
                self._errors = self._errors + (1.0 - _FORGETS) * (squares - self._errors)
            self.model.learn(at.rows)
            learned = True
        if learned:
            self.model.solve()
        return learned


class _MomentWindow:
    """Moments on the last of the tool's way, as sums. last: the newest of them. added: how many ever were."""

    last: _Moment
    added = 0

    def __init__(self, rows: int) -> None:
        self._moments: deque[_Moment] = deque()
        self._rows, self._squares, self._felt = np.zeros((rows, 4)), np.zeros((rows, 4, 4)), np.zeros(3)

    @property
    def count(self) -> int:
        return len(self._moments)

    def add(self, moment: _Moment) -> None:
        """Take a moment, if the tool has gone on since the last, and forget those that are far behind.

        The first few count as they come: what is locked is never moved, and is compared with the arm as it stood.
        """
        if len(self._moments) >= _MIN and moment.way - self.last.way < _STEP:
            return
        self._moments.append(moment)
        self.last = moment
        self.added += 1
        self._sum(moment, 1.0)
        while self._moments[0].way < moment.way - _BEFORE:
            self._sum(self._moments.popleft(), -1.0)

    def clear(self) -> None:
        self.__init__(len(self._rows))  # type: ignore[misc]

    def means(self) -> tuple[Array, Array, Array]:
        """Means of the rows (m, 4), of their products (m, 4, 4), and of the felt force (3,)."""
        n = len(self._moments)
        return self._rows / n, self._squares / n, self._felt / n

    def _sum(self, moment: _Moment, sign: float) -> None:
        z = sign * moment.rows
        self._rows += z
        self._squares += z[:, :, None] * moment.rows[:, None, :]
        self._felt += sign * moment.felt


def _force(left: Array, spread: Array, compliance: Array, unsure: Array, L: Array, moved: bool) -> tuple[Array, Array]:
    """The forces (k,) [N] that rows show by what is left of their leads (m, k), and what they are at least.

    spread (m,): of what is left. compliance, unsure (m,): of the rows, and how uncertain that is. L (6, m): their
    levers. moved: whether the tool has come some way: as a hand takes up a load it is drawn aside, and what a servo
    yields is learned from little.
    """
    load = left[:, 0] / np.maximum(compliance, unsure)  # at first what every row shows by itself
    for _ in range(_PASSES):
        s = np.sqrt(spread**2 + (unsure * load) ** 2)
        size, deviation, wrench = _shown(left, s, s, compliance, L)
        load = L.T @ wrench
    if not moved:
        return size, size - _SURE * deviation
    # of a servo that yields, by how much is hardly known, a lead that stands out is a force all the same: as large as
    # it takes on the softest that it may be
    softest = np.where(compliance > 0.0, compliance + _SURE * unsure, 0.0)
    soft, scatter, _ = _shown(left, s, spread, softest, L)
    return size, np.maximum(size - _SURE * deviation, np.minimum(soft, size) - _SURE * scatter)


def _shown(left: Array, s: Array, spread: Array, compliance: Array, L: Array) -> tuple[Array, Array, Array]:
    """The forces (k,) [N] of the smallest wrenches that show as leads (m, k), their standard deviations where rows
    scatter by spread (m,), and the first of these wrenches (6,). s (m,): what rows count by.
    """
    A = -(compliance / s)[:, None] * L.T  # (m, 6)
    shown = np.linalg.solve(A.T @ A + _PRIOR, A.T)  # (6, m)
    wrench = shown @ (left / s[:, None])  # (6, k)
    f = wrench[:3]
    size = np.sqrt((f * f).sum(axis=0))
    along = (f.T @ shown[:3]) * (spread / s)  # (k, m)
    return size, np.sqrt((along**2).sum(axis=1)) / np.maximum(size, 1e-9), wrench[:, 0]

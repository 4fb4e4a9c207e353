"""The wrench on the tool that the joints' efforts show: a force sensor in every arm whose stack reports torques.

Drives give e for gravity g, the motion, friction f and the wrench w on the tool:

    e = g(q) + M(q) q̈ + f − Jᵀ w.

Everything is smoothed alike, by two low-passes of lag 1/K in a row. So q̈ = K² (q − 2 q₁ + q₂), with q₁ and q₂ after
one and two of them: the generalised momentum observer of second order, which differentiates no speed. C q̇ is left out;
it is below 0.1 N m in a pull. w follows by least squares, weighted by how well every joint is known, with a prior, so
that its covariance says which directions the efforts do not see.
Dry friction is the largest error. It acts against the speed, and of a joint that hardly moves it counts as uncertainty.
Its size, the tool's weight and the errors of the torque constants are learned from motions that the arm makes before it
takes hold (:class:`FreeMotion`, :func:`modcal_core.robots.weigh`). Of an arm that was not seen moving, what efforts
leave beside the stated masses is taken for zero, and its size for the uncertainty.

Whether torques are reported at all is told by the arm's own weight. Currents, efforts without gravity, and gears whose
friction bears the weight are not used.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import TypeGuard

import numpy as np

from modcal_core.errors import BadCommand, ModcalError, NotEnoughData
from modcal_core.geometry import Array
from modcal_core.impedance.task import JointPositions
from modcal_core.impedance.wrench import LowPass, SensorWeighing
from modcal_core.robots import Chain, HeldWeight, Inertias, Stands, Weighed, mass_matrix, torque, weigh

_MOST = 3.0  # times the full effort may a reading be: what drives give for a moment is no more
_READINGS, _STANDS = 50, 2e-3  # readings at rest that count; rad or m by which they may differ
_FEWEST = 10  # of them, for a mean
_LIKE = 0.25  # of the arm's weight may be off: currents are off by ten times, gravity that is left out is all of it
_GOOD = 0.03  # of the full effort may be left of single joints, else friction bears the weight and tells no force
_FLOOR = 0.005  # of the full effort: torque sensors are no better when postures and loads change
_MODEL = 0.01  # of the full effort: what masses off by 10 % and torque constants by 5 % leave once they were learned
_TWICE = math.sqrt(2.0)  # a force is a difference of two readings
# N, N m: what no pull comes to; a hand holds a handle some centimetres off its middle at most
_PRIOR = np.diag([200.0**-2.0] * 3 + [3.0**-2.0] * 3)
_CUTOFF = 30.0  # Hz, as the wrench is smoothed by default
_EVERY = 8  # readings after which weight and levers are looked up again: 2 mm of the fastest pull
_SLIDES = 3e-3  # rad/s or m/s at which half of a joint's friction is sure to act against its speed
_STANDING = 1.0 / 3.0  # of friction's square, the variance of what may be anywhere between both sides
_LIKELY, _SURE = 2.0, 3.0  # standard deviations by which a force slows the pull, and ends it, or a moment turns a hand
_SHARE = 0.4  # of the force that may go unfelt, for as much again comes until the arm stands
_LASTS = 0.06  # s: while an arm is jerked its inertia is a load as well, for half of that
_SEES = 0.2  # of the force: a direction with a larger standard deviation is not seen


@dataclass(frozen=True)
class ArmEfforts:
    """What is known of an arm whose joints may report efforts. full (n,): largest effort of each [N m; N]."""

    chain: Chain
    bodies: Inertias
    full: Array


_SPAN = 0.12  # s whose readings make one moment
_MOVES, _SLOW = 0.02, 4e-3  # rad/s of some joint of a moment that is kept; below which a joint's side is not known
_APART = 0.03  # rad of some joint between two moments
_MOMENTS = 150


@dataclass
class FreeMotion:
    """What joints, and the sensor at the wrist, reported before the arm took hold of anything. Take every reading."""

    sensor: SensorWeighing = field(default_factory=SensorWeighing)

    _lately: deque[JointPositions] = field(default_factory=deque)
    _kept: deque[tuple[Array, Array, Array, Array]] = field(default_factory=lambda: deque(maxlen=_MOMENTS))

    def take(self, joints: JointPositions) -> None:
        """Note a reading; of an arm that moves some way further it becomes a moment."""
        lately = self._lately
        if lately and not 0.0 < joints.stamp - lately[-1].stamp < _SPAN:
            if joints.stamp == lately[-1].stamp:
                return
            lately.clear()
        lately.append(joints)
        if joints.stamp - lately[0].stamp < _SPAN:
            return
        some, middle = list(lately), len(lately) // 2
        lately.popleft()
        if self._kept and np.abs(some[middle].q - self._kept[-1][0]).max() <= _APART:
            return
        efforts = [one.effort for one in some if one.effort is not None]
        if len(some) < 3 or len(efforts) < len(some):
            return
        first, last = some[middle].stamp - some[0].stamp, some[-1].stamp - some[middle].stamp
        before, after = (some[middle].q - some[0].q) / first, (some[-1].q - some[middle].q) / last
        v, a = 0.5 * (before + after), (after - before) / (0.5 * (first + last))
        if np.abs(v).max() > _MOVES:
            self._kept.append((some[middle].q, v, a, np.mean(efforts, axis=0)))

    def weighed(self, arm: ArmEfforts, down: Array) -> Weighed | None:
        """Payload, friction and torque constants of the arm; None where it has moved too little. Raises BadRecording.

        down (3,): gravity in the base [m/s²].
        """
        if not self._kept:
            return None
        q, v, a, effort = (np.array(values) for values in zip(*self._kept, strict=True))
        moved = torque(arm.chain, arm.bodies, q, v, a, down) - torque(arm.chain, arm.bodies, q, 0.0 * v, 0.0 * a, down)
        side = np.where(np.abs(v) > _SLOW, np.sign(v), 0.0)
        effort = np.where(side != 0.0, effort - moved, np.nan)
        try:
            return weigh(arm.chain, arm.bodies.pulled(down), [Stands(q, effort, side, loaded=True)], torques=True)
        except NotEnoughData:
            return None


class JointForce:
    """Take every tick. wrench (6,): on the tool, in its axes. covariance (6, 6) of it.

    force: that is surely there [N], beside errors that are likely. load (n,): what the joints give beyond their weight
    [N m; N]. stamp: of the last efforts that were used [s]. unusable: why none are, as text.
    """

    lag = 2.0 / (2.0 * math.pi * _CUTOFF)  # s by which the wrench comes late

    def __init__(self, arm: ArmEfforts | None, down: Array) -> None:
        """Nothing was read yet. down (3,): gravity in the base [m/s²]."""
        self.unusable = "" if arm is not None else "masses or efforts of the joints are not known"
        self.wrench, self.covariance, self.load = np.zeros(6), np.diag(1.0 / np.diag(_PRIOR)), np.zeros(0)
        self.force = self._surely = 0.0
        self._arm, self._down = arm, down
        self._weight = None if arm is None else HeldWeight(arm.chain, arm.bodies.pulled(down))
        self._filters = LowPass(_CUTOFF), LowPass(_CUTOFF)
        self._rest: deque[tuple[Array, Array]] = deque(maxlen=_READINGS)
        self._error = np.zeros(0)  # (n,) standard deviation of the joints' efforts, beside friction [N m; N]
        self._friction, self._unsure, self._side = (np.zeros(0) for _ in range(3))  # each (n,)
        self._zero, self._hangs, self._gain = np.zeros(0), 0.0, np.ones(0)
        self._own, self._mass, self._shows = np.zeros(0), np.zeros((0, 0)), np.zeros((6, 0))
        self._taken, self.stamp, self._since = 0, -math.inf, math.inf

    def rest(self, joints: JointPositions) -> None:
        """Note a reading of an arm that stands and touches no more than it will hold."""
        if not self._plausible(joints.effort):
            return
        if self._rest and np.abs(joints.q - self._rest[0][0]).max() > _STANDS:
            self._rest.clear()
        self._rest.append((joints.q, joints.effort))

    def begin(self, J: Array, motion: FreeMotion | None = None) -> None:
        """The pull begins: are efforts torques? J (6, n): of the tool, in its axes. motion: seen of the arm before."""
        arm, weight = self._arm, self._weight
        if arm is None or weight is None:
            return
        if len(self._rest) < _FEWEST:
            self.unusable = "joint states contain no efforts"
            return
        n, q, effort = arm.chain.n, self._rest[-1][0], np.mean([e for _, e in self._rest], axis=0)
        try:
            known = None if motion is None else motion.weighed(arm, self._down)
        except ModcalError as refused:
            self.unusable = f"{refused.offender} {refused.limit}"
            return
        dry = np.zeros(n) if known is None else known.friction
        own, load = weight.efforts(q), weight.of_load(q)
        left, per = (effort - own) / arm.full, load / arm.full
        self._hangs = float(left @ per) / max(float(per @ per), 1e-12)
        left = left - self._hangs * per
        beyond = np.maximum(np.abs(left) - dry / arm.full, 0.0)
        error = float(np.linalg.norm(beyond))
        if not error <= _LIKE * float(np.linalg.norm(own / arm.full)):
            worst = int(np.argmax(beyond))
            unit = "N m" if arm.chain.revolute[worst] else "N"
            takes = f"the arm's weight takes {own[worst]:.3g} {unit}"
            self.unusable = f"{arm.chain.names[worst]} reports {effort[worst]:.3g} where {takes}"
            return
        error /= math.sqrt(n - 1)
        if not error <= _GOOD:
            self.unusable = f"at rest they are off by {100.0 * error:.0f} % of the joints' full effort"
            return
        self._friction, self._gain, bodies = dry, np.ones(n), arm.bodies
        if known is None:
            self._error, self._unsure = _TWICE * max(error, _FLOOR) * arm.full, np.zeros(n)
            self._zero = left * arm.full
        else:  # of what is left some is friction, on whatever side, and some the model's error
            bodies = known.bodies
            self._weight, self._hangs, self._gain, self._unsure = (
                HeldWeight(arm.chain, known.bodies), 0.0, known.scale, known.friction_std
            )  # fmt: skip
            rest = known.scale * effort - known.offset - self._weight.efforts(q)
            model, turns = known.scatter**2 + (_MODEL * arm.full) ** 2, _STANDING * dry**2
            self._error = np.sqrt(model)
            self._zero = model / (model + turns) * rest + known.offset
            own = self._weight.efforts(q)
        self._own, self._mass = own + self._hangs * load, mass_matrix(arm.chain, bodies, q[None])[0]
        self._side = np.ones(n)  # what the efforts see is asked of an arm that goes: one that stands may wait
        self._look_up(J)

    def take(self, joints: JointPositions, J: Array) -> None:
        """Look at a reading. J (6, n): of the tool, in its axes."""
        if not len(self._error) or joints.stamp <= self.stamp:
            return
        if not self._plausible(joints.effort):
            self.force = self._surely = 0.0
            return
        self.stamp, lag = joints.stamp, self._filters[0].lag
        first = self._filters[0].take(np.stack([joints.q, self._gain * joints.effort]), joints.stamp)
        q, effort = self._filters[1].take(first, joints.stamp)
        speed = (first[0] - q) / lag
        self._side = speed / (np.abs(speed) + _SLIDES)
        if self._taken % _EVERY == 0:
            assert self._weight is not None
            self._own = self._weight.efforts(q) + (self._hangs * self._weight.of_load(q) if self._hangs else 0.0)
        elif self._taken % _EVERY == _EVERY // 2:  # not both at once, which takes longer
            self._look_up(J)
        self._taken += 1
        acceleration = (joints.q - 2.0 * first[0] + q) / lag**2
        self.load = effort - self._zero - self._own
        self.wrench = self._shows @ (self._mass @ acceleration + self._friction * self._side - self.load)
        size, deviation = self._size(slice(0, 3))
        self.force, self._surely = max(size - _LIKELY * deviation, 0.0), max(size - _SURE * deviation, 0.0)

    @property
    def tells(self) -> bool:
        """Whether the efforts are used."""
        return len(self._error) > 0

    def hides(self, most: float) -> float:
        """By how much a force sensor may depart from the efforts before it is noticed [N]. most: as of refused."""
        return _SHARE * most + _SURE * self.deviation

    @property
    def deviation(self) -> float:
        """Standard deviation of the force, in its direction [N]."""
        return self._size(slice(0, 3))[1]

    @property
    def surely(self) -> Array:
        """The wrench (6,) less what its uncertainty may be: what a hand may yield to without going astray."""
        out = self.wrench.copy()
        for part, times in ((slice(0, 3), _LIKELY), (slice(3, 6), _SURE)):
            size, deviation = self._size(part)
            out[part] *= max(1.0 - times * deviation / max(size, 1e-9), 0.0)
        return out

    def unseen(self, most: float) -> Array:
        """Directions (k, 3), in the tool's axes, in which the efforts do not tell a force as large as this one [N]."""
        variances, directions = np.linalg.eigh(self.covariance[:3, :3])
        return np.asarray(directions[:, variances > (_SEES * most) ** 2].T)

    def refused(self, felt: Array, stamp: float, most: float) -> BadCommand | None:
        """Why to let go: the force sensor and the efforts have surely said different things for a while.

        felt (3,): force that the sensor says, in the tool's axes [N]. most: that may be felt [N].
        """
        apart = self.wrench[:3] - felt
        size = math.sqrt(apart @ apart)
        sure = size - _SURE * math.sqrt(apart @ self.covariance[:3, :3] @ apart) / max(size, 1e-9)
        if not len(self._error) or sure <= _SHARE * most:
            self._since = math.inf
            return None
        self._since = min(self._since, stamp)
        if stamp - self._since < _LASTS:
            return None
        shown, says = math.sqrt(self.wrench[:3] @ self.wrench[:3]), math.sqrt(felt @ felt)
        said = f"{says:.0f} N are felt and the efforts of the joints show {shown:.0f} N, {sure:.0f} N apart at least"
        return BadCommand("wrench", said, "check the force sensor, and the efforts of joint_states")

    def _size(self, part: slice) -> tuple[float, float]:
        """Size of the force or the moment, and its standard deviation; the largest one where it is nothing."""
        w, covariance = self.wrench[part], self.covariance[part, part]
        size = math.sqrt(w @ w)
        if size < 1e-9:
            return 0.0, math.sqrt(float(np.linalg.eigvalsh(covariance)[-1]))
        return size, math.sqrt(w @ covariance @ w) / size

    def _plausible(self, effort: Array | None) -> TypeGuard[Array]:
        """Whether efforts were reported, and no drive would have to give some times what it can."""
        return effort is not None and self._arm is not None and bool((np.abs(effort) <= _MOST * self._arm.full).all())

    def _look_up(self, J: Array) -> None:
        dry = _STANDING * ((1.0 - np.abs(self._side)) * self._friction) ** 2 + (self._side * self._unsure) ** 2
        A = J.T / (spread := np.sqrt(self._error**2 + dry))[:, None]
        # a moment that stands out of what is usual is there: kept small, it would be taken for a force
        prior, moment = _PRIOR.copy(), self.wrench[3:]
        prior[3:, 3:] /= max(1.0, float(moment @ moment) * _PRIOR[5, 5])
        self.covariance = np.asarray(np.linalg.inv(A.T @ A + prior), dtype=float)
        self._shows = np.asarray(self.covariance @ (A.T / spread), dtype=float)

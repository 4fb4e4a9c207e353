"""The force on the tool that the joints' efforts show: a second force sensor, where the stack reports torques.

At rest and in slow motion the joints give

    e = g(q) − Jᵀ w,

with what the arm's own weight asks of them, g, and the wrench w on the tool. So w follows by least squares, and no
wrench sensor that is stuck, deaf or not connected takes part in it. Nor does it depend on how the servos hold the arm:
what an integral part takes out of a lead stands in the effort.

Whether what is reported are torques, and how good they are, is told by the arm's own weight. Standing, before anything
is pulled, the efforts must be what the masses of the robot description ask for, with a load at the tip that may be
unknown. Currents, efforts that leave gravity out, and gears whose friction bears the weight are not. What is left then,
as a share of the joints' full effort, is the uncertainty of every reading. A wrench that is there at the beginning,
as of a hand that was clenched about a handle, is no force of the pull.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TypeGuard

import numpy as np

from modcal_core.errors import BadCommand
from modcal_core.geometry import Array
from modcal_core.impedance.task import JointPositions
from modcal_core.impedance.wrench import LowPass
from modcal_core.robots import Chain, HeldWeight, Inertias

_MOST = 3.0  # times the full effort may a reading be: what drives give for a moment is no more
_READINGS, _STANDS = 50, 2e-3  # readings at rest that count; rad or m by which they may differ
_FEWEST = 10  # of them, for a mean
_LIKE = 0.25  # of the arm's weight may be off: currents are off by ten times, gravity that is left out is all of it
_GOOD = 0.03  # of the full effort may be left of single joints, else friction bears the weight and tells no force
_FLOOR = 0.005  # of the full effort: torque sensors are no better when postures and loads change
_TWICE = math.sqrt(2.0)  # a force is a difference of two readings
_PRIOR = np.diag([200.0**-2.0] * 3 + [30.0**-2.0] * 3)  # N, N m: what no pull comes to
_CUTOFF = 30.0  # Hz, as the wrench is smoothed by default
_EVERY = 8  # readings after which weight and levers are looked up anew: 2 mm of the fastest pull
_LIKELY, _SURE = 2.0, 3.0  # standard deviations by which a force slows the pull, and ends it
_SHARE = 0.4  # of the force that may go unfelt, for as much again comes until the arm stands
_LASTS = 0.06  # s: while an arm is jerked its inertia is a load as well, for half of that


@dataclass(frozen=True)
class ArmEfforts:
    """What is known of an arm whose joints may report efforts. full (n,): largest effort of each [N m; N]."""

    chain: Chain
    bodies: Inertias
    full: Array


class EffortCheck:
    """Take every tick. force: that the efforts surely show [N]; unusable: why they are not used, as text."""

    def __init__(self, arm: ArmEfforts | None, down: Array) -> None:
        """Nothing was read yet. down (3,): gravity in the base, of any length."""
        self.force = 0.0
        self.unusable = "" if arm is not None else "masses or efforts of the joints are not known"
        self._arm = arm
        self._weight = None if arm is None else HeldWeight(arm.chain, arm.bodies.pulled(down))
        self._filter = LowPass(_CUTOFF)
        self._rest: deque[tuple[Array, Array]] = deque(maxlen=_READINGS)
        self._error = np.zeros(0)  # (n,) standard deviation of the joints' efforts [N m; N]
        self._at_first = np.zeros(3)  # force when the pull began, in the base
        self._own = np.zeros(0)
        self._shows: Array = np.zeros((6, 0))
        self._covariance: Array = np.zeros((3, 3))
        self._taken, self._stamp = 0, -math.inf
        self._surely, self._since = 0.0, math.inf

    def rest(self, joints: JointPositions) -> None:
        """Note a reading of an arm that stands and touches no more than it will hold."""
        if not self._plausible(joints.effort):
            return
        if self._rest and np.abs(joints.q - self._rest[0][0]).max() > _STANDS:
            self._rest.clear()
        self._rest.append((joints.q, joints.effort))

    def begin(self, R: Array, J: Array) -> None:
        """The pull begins: see whether efforts are torques. R (3, 3): the tool in the base; J (6, n): of the tool."""
        arm, weight = self._arm, self._weight
        if arm is None or weight is None:
            return
        if len(self._rest) < _FEWEST:
            self.unusable = "joint states contain no efforts"
            return
        q, effort = self._rest[-1][0], np.mean([e for _, e in self._rest], axis=0)
        own, load = weight.efforts(q), weight.of_load(q)
        left, per = (effort - own) / arm.full, load / arm.full
        mass = float(left @ per) / max(float(per @ per), 1e-12)
        left = left - mass * per
        shares = float(np.linalg.norm(left)), float(np.linalg.norm(own / arm.full))
        if not shares[0] <= _LIKE * shares[1]:
            worst = int(np.argmax(np.abs(left)))
            unit = "N m" if arm.chain.revolute[worst] else "N"
            takes = f"the arm's weight takes {own[worst]:.3g} {unit}"
            self.unusable = f"{arm.chain.names[worst]} reports {effort[worst]:.3g} where {takes}"
            return
        error = shares[0] / math.sqrt(len(left) - 1)
        if not error <= _GOOD:
            self.unusable = f"at rest they are off by {100.0 * error:.0f} % of the joints' full effort"
            return
        self._error = _TWICE * max(error, _FLOOR) * arm.full
        self._own = own
        self._look_up(J)
        self._at_first = R @ (self._shows @ (effort - self._own))[:3]

    def take(self, joints: JointPositions, R: Array, J: Array) -> None:
        """Look at a reading. R (3, 3): the tool in the base; J (6, n): of the tool, in its axes."""
        if not len(self._error) or joints.stamp <= self._stamp:
            return
        if not self._plausible(joints.effort):
            self.force = self._surely = 0.0
            return
        effort, self._stamp = self._filter.take(joints.effort, joints.stamp), joints.stamp
        if self._taken % _EVERY == 0:
            assert self._weight is not None
            self._own = self._weight.efforts(joints.q)
        elif self._taken % _EVERY == _EVERY // 2:  # not both at once, which takes longer
            self._look_up(J)
        self._taken += 1
        f = (self._shows @ (effort - self._own))[:3] - R.T @ self._at_first
        size = math.sqrt(f @ f)
        deviation = math.sqrt(f @ self._covariance @ f) / max(size, 1e-9)
        self.force, self._surely = max(size - _LIKELY * deviation, 0.0), max(size - _SURE * deviation, 0.0)

    def refused(self, felt: float, stamp: float, most: float) -> BadCommand | None:
        """Why to let go: the efforts have surely shown more than is felt [N] for a while, by more than may be.

        most: that may be felt [N].
        """
        if self._surely - felt <= _SHARE * most:
            self._since = math.inf
            return None
        self._since = min(self._since, stamp)
        if stamp - self._since < _LASTS:
            return None
        said = f"{felt:.0f} N are felt but the efforts of the joints show {self._surely:.0f} N at least"
        return BadCommand("wrench", said, "check the force sensor, and the efforts of joint_states")

    def _plausible(self, effort: Array | None) -> TypeGuard[Array]:
        """Whether efforts were reported, and no drive would have to give some times what it can."""
        return effort is not None and self._arm is not None and bool((np.abs(effort) <= _MOST * self._arm.full).all())

    def _look_up(self, J: Array) -> None:
        A = -J.T / self._error[:, None]
        covariance = np.asarray(np.linalg.inv(A.T @ A + _PRIOR), dtype=float)
        self._shows = np.asarray(covariance @ (A.T / self._error), dtype=float)
        self._covariance = covariance[:3, :3]

"""Force on the tool, its prediction, and the speed that it allows."""

from __future__ import annotations

import math

import numpy as np

from modcal_core.errors import BadCommand
from modcal_core.geometry import Array
from modcal_core.impedance.joint_force import ArmEfforts, FreeMotion, JointForce
from modcal_core.impedance.observer import ALLOWED, Observer
from modcal_core.impedance.safety_monitor import Limits
from modcal_core.impedance.setpoint_filter import SetpointFilter
from modcal_core.impedance.speed_governor import ForcePrediction
from modcal_core.impedance.task import ImpedanceTask, JointPositions
from modcal_core.impedance.wrench import LowPass, WrenchSensor
from modcal_core.robots import mass_matrix

_LIKELY, _SURE = 2.0, 3.0  # standard deviations of what a sensor tells, to believe it and to refuse it
# kg m² that a rotor adds through its gear, beside the masses of a description; kg of an arm whose masses are not known;
# and at most, next to a singular posture; rad that joints may have gone since it was looked up
_ROTOR, _MASS, _HEAVY, _ELSEWHERE = 0.1, 12.0, 50.0, 0.05
_MISTOLD = 0.1  # of a force may a sensor tell more or less: a sensor and a stated mass are no better
_TOGETHER = 0.02  # s by which a wrench may be older than joints that it is compared with: one of 50 Hz


class ToolForce:
    """felt (6,): wrench on the tool in its axes. foreseen (6,): what it will have come to when the arm stands.

    delay: from a touch until the arm begins to brake [s]. size: of the felt force and of what the servos show beside
    it, or of what the efforts show where that is more [N]; ``foreseen`` has that as well. tool (3,): where it was as it
    felt that [m]. efforts: see there.
    """

    def __init__(
        self,
        joints: int,
        task: ImpedanceTask,
        limits: Limits,
        least: Array | None = None,
        arm: ArmEfforts | None = None,
    ) -> None:
        """Nothing is felt yet. least (joints,): stiffness of each joint's servo at least [N m/rad], if known.

        arm: what is known of the efforts that they report.
        """
        self.task, self.limits = task, limits
        self.felt, self.foreseen, self.tool = np.zeros(6), np.zeros(6), np.zeros(3)
        self.delay = self.size = 0.0
        self._foresight = ForcePrediction()
        # what efforts say is not judged by what servos yield: friction is in it
        self._least = np.full(joints, np.nan) if least is None or self.by_efforts else least
        self.observer = Observer(task, limits.period, self._least)
        self.efforts = JointForce(arm, task.gravity)
        self._scale: tuple[float, float] | None = None  # of the sensor, by the tool's weight, and its deviation
        self._arm, self._hangs, self._mobility = arm, 0.0, (np.full(joints, np.inf), np.zeros((joints, joints)))
        self._place: LowPass | None = None

    def begin(self, J: Array, motion: FreeMotion | None, mass: float) -> str:
        """The arm stands and is about to pull: why it must not, as text; empty where it may. J (6, n): of the tool.

        motion: what was seen of the arm before. mass: that hangs on the force sensor, if it is stated [kg].
        """
        efforts, most, self._hangs = self.efforts, self.limits.force, mass
        efforts.begin(J, motion)
        if not self.by_efforts:
            self._scale = None if motion is None else motion.sensor.scale(mass, self.task.gravity)
            if self._scale is None:
                return ""
            if abs(self._scale[0] - 1.0) - _SURE * self._scale[1] <= _MISTOLD:
                # what was measured of the sensor takes the place of what is assumed of the joints: a sound one is not
                # blamed for servos that are softer, or for their friction
                self.observer = Observer(self.task, self.limits.period, self._least, judges=False)
                return ""
            said = f"the force sensor tells {self._scale[0]:.2f} of what tool_mass weighs, within {self._scale[1]:.2f}"
            return f"{said}: correct its unit, its sign (wrench_by_tool) or tool_mass, or use wrench: efforts"
        if efforts.unusable:
            return (
                f"the joints' efforts tell no force: {efforts.unusable}: use a force sensor, or correct what is wrong"
            )
        if len(blind := efforts.unseen(most)):
            way = ", ".join(f"{x:.2f}" for x in blind[-1])
            said = f"the joints' efforts tell a force along ({way}) of the tool within {efforts.deviation:.0f} N only"
            return f"{said}: take another posture, move the arm freely before, or use a force sensor"
        return ""

    @property
    def bound(self) -> float:
        """The force [N] that may be on the tool when the limit is felt; NaN where nothing was measured that tells."""
        most, bounds = self.limits.force, []
        if self.efforts.tells:
            bounds.append(most if self.by_efforts else (1.0 + ALLOWED) * most + _SURE * self.efforts.deviation)
        if self._scale is not None:
            bounds.append(most / (self._scale[0] - _LIKELY * self._scale[1]))
        return min(bounds, default=math.nan)

    def overload(self) -> BadCommand | None:
        """Why to let go: what the efforts may leave unsaid is beyond the limit with what they say, or None."""
        size = math.sqrt(self.felt[:3] @ self.felt[:3]) + self.unsure
        if not self.by_efforts or size <= self.limits.force:
            return None
        said = f"may be {size:.0f} N by the joints' efforts, {self.limits.force:g} N is the limit"
        return BadCommand("force", said, "check what blocks the object")

    def restrict(self, task: ImpedanceTask, limits: Limits) -> None:
        """Keep to other limits, and to the stiffness that another task states."""
        self.task, self.limits = task, limits
        self.observer.restrict(task)

    def take(
        self, now: float, T: Array, sensor: WrenchSensor, joints: JointPositions, sent: SetpointFilter, braking: float
    ) -> None:
        """Look at the readings of now [s]. sent: has the last setpoint. braking: time until the arm stands [s]."""
        task, heard = self.task, joints.stamp if self.by_efforts else sensor.stamp
        self.efforts.take(joints, sent.jacobian)
        self.felt = self.efforts.wrench if self.by_efforts else sensor.on_tool(T, task.gravity)
        if (raw := joints.effort if self.by_efforts else sensor.raw) is not None:
            self.observer.hear(raw, heard)
        if heard >= joints.stamp - _TOGETHER:  # what was felt long before the joints were read tells nothing
            efforts = (self.efforts.load, self.efforts.deviations) if self.efforts.tells else None
            self.observer.take(joints, now, self.felt, sent.jacobian, self.limits.force, efforts)
        age = max(now - joints.stamp, now - heard, 0.0)
        lag = self.efforts.lag if self.by_efforts else sensor.lag
        self.delay = age + self.limits.period + lag + self._foresight.lag + task.servo_lag
        self._place = self._place or LowPass(1.0 / (2.0 * math.pi * lag))
        self.tool = self._place.take(T[:3, 3], joints.stamp)
        felt = math.sqrt(self.felt[:3] @ self.felt[:3])
        self.size = max(felt + self.observer.hidden + self.unsure, self.efforts.force)
        known = self.felt.copy()
        known[:3] = known[:3] * (self.size / felt) if felt > 0.0 else (self.size, 0.0, 0.0)
        self.foreseen = self._foresight.ahead(known, heard, self.delay + braking)

    def sent(self, setpoint: SetpointFilter, now: float) -> None:
        """Note the setpoint that is sent at time ``now`` [s]."""
        self.observer.sent(setpoint.q, setpoint.pose[:3, 3], now)

    def refused(self, joints: JointPositions) -> BadCommand | None:
        """Why to let go: more than is allowed may be on the tool, and is not felt; or None."""
        if self.by_efforts and joints.stamp - self.efforts.stamp > self.limits.timeout:
            said = "contain no efforts that can be, any more"
            return BadCommand("joint_states", said, "check the driver")
        felt, apart = self.felt[:3], 0.0 if self.by_efforts else self.efforts.apart(self.felt[:3])
        return self.observer.refused(math.sqrt(felt @ felt), apart, joints.stamp, self.limits.force)

    @property
    def by_efforts(self) -> bool:
        """Whether the joints' efforts tell the force, and no sensor does."""
        return self.task.wrench == "efforts"

    @property
    def unsure(self) -> float:
        """By how much more may be on the tool than the efforts show, where they tell the force [N]."""
        return _LIKELY * self.efforts.deviation if self.by_efforts else 0.0

    @property
    def sure(self) -> Array:
        """The wrench (6,) that is felt, without what is not sure of it, in the tool's axes."""
        return self.efforts.surely if self.by_efforts else self.felt

    def speed(self, progress: float, known: bool) -> float:
        """The speed [m/s] at which to go on, the tool being so far [m] from its start. known: whether the path is."""
        self.observer.note(math.sqrt(self.felt[:3] @ self.felt[:3]), progress)
        if self.by_efforts:
            return self.task.speed if known else self.task.exploration_speed
        return self.observer.speed(progress, known, self.limits.force)

    def hold(self, way: Array, sent: SetpointFilter) -> tuple[float, float]:
        """Stiffness by which the servos hold the tool [N/m], and the arm's mass [kg], along a way (3,) in its axes."""
        task = self.task
        stiff = task.stiffness[0]  # what a compliant stack is asked for
        if task.mode == "admittance":
            stiff = self.observer.stiffness(way, sent.jacobian)
        if self._arm is None:
            return stiff, _MASS + self._hangs
        at, mobility = self._mobility
        if not np.abs(sent.q - at).max() <= _ELSEWHERE:
            M = mass_matrix(self._arm.chain, self._arm.bodies, sent.q[None])[0]
            mobility = np.linalg.inv(M + np.diag(_ROTOR * self._arm.chain.revolute))
            self._mobility = sent.q.copy(), mobility
        levers = sent.jacobian[:3].T @ way
        return stiff, 1.0 / max(float(levers @ mobility @ levers), 1.0 / _HEAVY) + self._hangs

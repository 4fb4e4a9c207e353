"""Force on the tool, its prediction, and whether the force sensor can be trusted.

A sensor that says a fifth of every force makes the servos seem five times as soft as they are. So it is believed only
where it has told of a force and the tool went on with that, and where the servos' leads, learned from what it said,
yield no more than the joints of this arm may.

Until then the hand goes no faster than what is hidden at a hard stop is found out in time. Where the servos surely
yield more than they may, the sensor is wrong, or the arm is softer than stated, and the pull is over.
"""

from __future__ import annotations

import math

import numpy as np

from modcal_core.errors import BadCommand
from modcal_core.geometry import Array
from modcal_core.impedance.joint_force import ArmEfforts, FreeMotion, JointForce
from modcal_core.impedance.lead_check import JointLeadCheck, LeadCheck, Stiffness
from modcal_core.impedance.safety_monitor import Limits
from modcal_core.impedance.setpoint_filter import SetpointFilter
from modcal_core.impedance.speed_governor import ForcePrediction
from modcal_core.impedance.task import ImpedanceTask, JointPositions
from modcal_core.impedance.unfelt_force import UnfeltForce
from modcal_core.impedance.wrench import LowPass, WrenchSensor
from modcal_core.robots import mass_matrix

_CREEP, _FREE = 0.01, 8e-3  # m/s for the first m, which no hand goes without what it holds
_UNTOLD = 0.5  # of the usual speed beyond that, until the force sensor has felt anything
_TOLD = 2.0  # N that tell that it does: ten times the noise of a usual one
_GOES_ON = 3e-3  # m that the tool goes on with it: as much as fingers yield to 60 N, which a jam tells as well
_LIKELY, _SURE = 2.0, 3.0  # standard deviations of what servos yield, to believe a sensor and to refuse it
_BEYOND = 1.15  # times as soft as may be: drives' friction and a lag that is not one make as much of it


class SensorEvidence:
    """Call every tick. ``told``: whether the sensor has shown a force under which the tool moved on."""

    def __init__(self, known: bool) -> None:
        """Nothing was told yet. known: whether it is known by how much joints may yield."""
        self.told = False
        self._known = known
        self._since = math.inf  # m of progress at which a force was felt first
        self._softness: tuple[float, float] | None = None

    def take(self, force: float, progress: float, repeats: bool) -> None:
        """Note a felt force [N] with the tool so far [m] on its way. repeats: whether the sensor repeats itself."""
        if force < _TOLD or repeats:
            self._since = math.inf
            self.told = self.told and not repeats
            return
        self._since = min(self._since, progress)
        self.told = self.told or progress - self._since >= _GOES_ON

    def learned(self, softness: tuple[float, float] | None) -> None:
        """Note what the servos yield as a share of what they may at most, and its standard deviation; None: unknown."""
        self._softness = softness

    @property
    def corroborated(self) -> bool:
        """Whether the sensor has shown a force and agrees with the servos' leads where they can be judged."""
        if not self._known or self._softness is None:
            return self.told and not self._known
        share, unsure = self._softness
        return self.told and share + _LIKELY * unsure <= 1.0

    @property
    def said(self) -> str:
        """What the servos yield, as text; empty while that is not known."""
        if self._softness is None:
            return ""
        share, unsure = self._softness
        return f"{share:.2f} of max_joint_lead_rad, within {_LIKELY * unsure:.2f}"

    def refused(self) -> BadCommand | None:
        """Why to let go: by what the sensor says the servos surely yield more than they may; None where all is well."""
        if self._softness is None:
            return None
        share, unsure = self._softness
        if share - _SURE * unsure <= _BEYOND:
            return None
        said = f"by what it says, the joints yield {share:.1f} times as much as they may"
        return BadCommand("wrench", said, "check the force sensor and max_joint_lead_rad")

    def exploring(self, progress: float, usual: float, creep: float) -> float:
        """The speed [m/s] at which to go on into the unknown, with the tool so far [m] from where it began.

        A force sensor that has not told of anything may be stuck, and so may one that told of little: until the hand
        has come some way, and until the sensor has told, little may come of that. creep: speed at which what a
        misstated lag hides is little [m/s].
        """
        slow = min(_CREEP, creep)
        if progress < _FREE:
            return min(usual, slow)
        return usual if self.told else min(usual, max(slow, _UNTOLD * usual * slow / _CREEP))

    def following(self, usual: float, exploring: float, creep: float) -> float:
        """The speed [m/s] along a known path: as while exploring, until the sensor is corroborated."""
        return usual if self.corroborated else min(usual, exploring * min(1.0, creep / _CREEP))


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
        self._leads = LeadCheck(_stiffness(task))
        self._unfelt = UnfeltForce(joints, task.servo_lag, limits.period, task.arm_stiffness)
        known = np.full(joints, np.nan) if least is None else least
        self.efforts = JointForce(arm, task.gravity)
        self._joints = JointLeadCheck(known, task.servo_lag, limits.period)
        judged = task.mode == "admittance" and bool(np.isfinite(known).any())
        self._evidence, self._least = SensorEvidence(judged), known
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
                self._least = np.full(J.shape[1], np.nan)
                self._joints = JointLeadCheck(self._least, self.task.servo_lag, self.limits.period)
                self._evidence = SensorEvidence(False)
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
            bounds.append(most if self.by_efforts else most + self.efforts.hides(most))
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
        self._leads.stiffness = _stiffness(task)

    def take(
        self, now: float, T: Array, sensor: WrenchSensor, joints: JointPositions, sent: SetpointFilter, braking: float
    ) -> None:
        """Look at the readings of now [s]. sent: has the last setpoint. braking: time until the arm stands [s]."""
        task, heard = self.task, joints.stamp if self.by_efforts else sensor.stamp
        self.efforts.take(joints, sent.jacobian)
        self.felt = self.efforts.wrench if self.by_efforts else sensor.on_tool(T, task.gravity)
        if not self.by_efforts:
            self._leads.felt(sensor.raw, heard)
        elif joints.effort is not None:
            self._leads.felt(joints.effort, heard)
        # a compliant stack takes no joint references; and what was felt long before the joints were read tells nothing
        if task.mode == "admittance" and heard >= joints.stamp - _TOGETHER:
            load = self.efforts.load if self.efforts.tells else None
            self._unfelt.take(joints, now, self.felt, sent.jacobian, self.limits.force, load)
        self._joints.heard(joints.stamp, now)
        if (servos := self._unfelt.servos) is not None:
            self._joints.learned(*servos)
        age = max(now - joints.stamp, now - heard, 0.0)
        lag = self.efforts.lag if self.by_efforts else sensor.lag
        self.delay = age + self.limits.period + lag + self._foresight.lag + task.servo_lag
        self._place = self._place or LowPass(1.0 / (2.0 * math.pi * lag))
        self.tool = self._place.take(T[:3, 3], joints.stamp)
        felt = math.sqrt(self.felt[:3] @ self.felt[:3])
        self.size = max(felt + self._unfelt.force + self.unsure, self.efforts.force)
        known = self.felt.copy()
        known[:3] = known[:3] * (self.size / felt) if felt > 0.0 else (self.size, 0.0, 0.0)
        self.foreseen = self._foresight.ahead(known, heard, self.delay + braking)

    def sent(self, setpoint: SetpointFilter, now: float) -> None:
        """Note the setpoint that is sent at time ``now`` [s]."""
        self._leads.sent(setpoint.pose[:3, 3], now)
        self._unfelt.sent(setpoint.q, now)
        self._joints.sent(setpoint.q, now)

    def refused(self, T: Array, joints: JointPositions, sent: SetpointFilter) -> BadCommand | None:
        """Why to let go: more than is allowed may be on the tool, and is not felt; or None."""
        felt, most = math.sqrt(self.felt[:3] @ self.felt[:3]), self.limits.force
        if self.by_efforts and joints.stamp - self.efforts.stamp > self.limits.timeout:
            said = "contain no efforts that can be, any more"
            return BadCommand("joint_states", said, "check the driver")
        lead = sent.moved_by(self.felt)
        refused = self._leads.refused(T[:3, 3], felt, joints.stamp, math.inf if self.efforts.tells else most, lead)
        if refused is None and self.task.mode == "admittance":
            load = self.efforts.load if self.efforts.tells else -sent.jacobian.T @ self.felt
            stiffest = self.task.arm_stiffness
            refused = self._joints.refused(joints, load, felt, sent.jacobian, most, stiffest)
        refused = refused or self._unfelt.refused(self.felt, most)
        if refused is not None or self.by_efforts:
            return refused
        return self.efforts.refused(self.felt[:3], joints.stamp, most) or self._evidence.refused()

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

    def exploring_speed(self, progress: float) -> float:
        """The speed [m/s] at which to go on into the unknown, with the tool so far [m] from where it began."""
        self._note(progress)
        if self.by_efforts:
            return self.task.exploration_speed
        return self._evidence.exploring(progress, self.task.exploration_speed, self._leads.creep(self.limits.force))

    def following_speed(self, progress: float) -> float:
        """The same along a path that is known."""
        self._note(progress)
        task = self.task
        if self.by_efforts:
            return task.speed
        return self._evidence.following(task.speed, task.exploration_speed, self._leads.creep(self.limits.force))

    def hold(self, way: Array, sent: SetpointFilter) -> tuple[float, float]:
        """Stiffness by which the servos hold the tool [N/m], and the arm's mass [kg], along a way (3,) in its axes."""
        task = self.task
        stiff = task.stiffness[0]  # what a compliant stack is asked for
        if task.mode == "admittance":
            stiff = self._unfelt.stiffness(way, sent.jacobian, task.arm_stiffness)
        if self._arm is None:
            return stiff, _MASS + self._hangs
        at, mobility = self._mobility
        if not np.abs(sent.q - at).max() <= _ELSEWHERE:
            M = mass_matrix(self._arm.chain, self._arm.bodies, sent.q[None])[0]
            mobility = np.linalg.inv(M + np.diag(_ROTOR * self._arm.chain.revolute))
            self._mobility = sent.q.copy(), mobility
        levers = sent.jacobian[:3].T @ way
        return stiff, 1.0 / max(float(levers @ mobility @ levers), 1.0 / _HEAVY) + self._hangs

    @property
    def servos(self) -> str:
        """By how much the joints' servos yield to the felt force, as text; empty while that is not known."""
        return self._evidence.said

    def _note(self, progress: float) -> None:
        self._evidence.take(math.sqrt(self.felt[:3] @ self.felt[:3]), progress, self._leads.repeats)
        self._evidence.learned(self._unfelt.softness(self._least))


def _stiffness(task: ImpedanceTask) -> Stiffness:
    if task.mode == "admittance":
        return Stiffness.of(task.governor.contact_stiffness, task.stack[0], task.servo_lag, task.arm_stiffness)
    return Stiffness(task.stiffness[0], task.stiffness[0], task.servo_lag)

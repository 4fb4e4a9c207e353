"""Safety monitor: the last check of every setpoint before it is sent. It changes no setpoint, it passes or refuses.

A refusal for a late input only means waiting: the next good setpoint may follow from the last one. After any other
refusal the monitor stays tripped until it is reset.

A force or a moment beyond its limit trips it as well. The last setpoint then stands, and with it the spring that the
servo has wound up. :meth:`SafetyMonitor.allow_release` unwinds it: for a second only setpoints that go back towards the
tool pass, whatever the force, and without a recent wrench.

Speeds are steps between passed setpoints over the time between them. A longer pause counts as a stop, after which no
more than one period's step is allowed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from modcal_core.errors import BadCommand
from modcal_core.geometry import Array, crossed, speeds
from modcal_core.robots import Chain, pose_and_jacobian

_ROUNDING = 1e-6  # share by which a number may exceed its limit for being rounded
_I = np.eye(3)
_PAUSE = 5.0  # periods without a setpoint, after which the arm counts as standing
_LETTING_GO = 1.0  # s
_BRAKES = 0.25  # share of the accelerations allowed with which a setpoint turns back, at least
_SLOWS = 0.5  # s in which what was faster than a new limit brakes: it may not become faster meanwhile
_AT_TOOL = 1e-3, 2e-3  # m, rad between setpoint and tool, within which neither can be told from where the other comes


@dataclass(frozen=True)
class Limits:
    """speed, acceleration: of the tool [m/s, m/s²]; turning, turning_acceleration [rad/s, rad/s²]. force, moment: on
    the tool [N, N m]. displacement, rotation: of the setpoint from where the tool is measured [m, rad]. joint_speed,
    joint_acceleration: (n,) per second. timeout: oldest input [s]. period: of setpoints [s]. gain: least singular value
    of the Jacobian [m or rad a rad]. consistency: how far the pose may be from where the joints put it
    [m; 5 times rad].
    """

    joint_speed: Array
    joint_acceleration: Array
    speed: float = 0.25
    acceleration: float = 2.5
    angular_speed: float = 1.5
    angular_acceleration: float = 15.0
    force: float = 50.0
    moment: float = 20.0
    displacement: float = 0.1
    rotation: float = 0.5
    timeout: float = 0.1
    period: float = 0.004
    gain: float = 0.02
    consistency: float = 0.02
    stiffness: tuple[float, float] = (5000.0, 500.0)
    wrench: tuple[float, float] = (50.0, 20.0)


@dataclass(frozen=True)
class ArmSetpoint:
    """What an arm is told. pose (4, 4): of the tool in ``frame``. q, velocity (n,): of the joints ``names``.

    wrench (6,): to be exerted on top of it. stiffness (6,): of the stack that follows, along and about the tool's axes.
    why: what the arm is doing, as text.
    """

    frame: str
    names: tuple[str, ...]
    pose: Array
    q: Array
    velocity: Array
    wrench: Array
    stiffness: Array
    why: str = ""


@dataclass(frozen=True)
class SensorReadings:
    """What the arm's sensors say. joints: name to position. T_base_tool (4, 4): where the tool is measured to be.

    wrench (6,): on the tool, in frame ``wrench_frame``, which must be the tool's. Stamps [s].
    """

    joints: dict[str, float]
    joints_stamp: float
    T_base_tool: Array
    wrench: Array
    wrench_frame: str
    wrench_stamp: float


class LateInput(BadCommand):
    """An input is too old: send nothing now; a moment later it may be possible again."""


@dataclass
class _Last:
    now: float
    pose: Array
    q: Array
    dt: float
    rates: tuple[Array, Array, Array] = field(default=(np.zeros(3), np.zeros(3), np.zeros(0)))


class SafetyMonitor:
    """Lets setpoints through, or raises BadCommand. ``tripped`` says why it lets nothing through any more, if so."""

    def __init__(self, chain: Chain, limits: Limits) -> None:
        """Shut, until it is opened."""
        self.chain, self.limits = chain, limits
        self.tripped = "it has not been opened yet"
        self._least = limits.gain**2 * np.eye(6)
        self._last: _Last | None = None
        self._now = -math.inf
        self._let_go = math.nan
        self._slows_until = -math.inf

    def restrict(self, limits: Limits, now: float) -> None:
        """Other limits from ``now`` [s] on. What is faster than they allow has half a second to brake."""
        self.limits, self._least = limits, limits.gain**2 * np.eye(6)
        self._slows_until = now + _SLOWS

    def gain_at(self, q: Array) -> float:
        """The smallest singular value of the Jacobian at joints (n,); infinite for arms with fewer than six."""
        if self.chain.n < 6:
            return math.inf
        J = pose_and_jacobian(self.chain, q)[1]
        return math.sqrt(max(float(np.linalg.eigvalsh(J @ J.T)[0]), 0.0))

    def open(self, pose: Array, q: Array, now: float) -> None:
        """Let setpoints through that follow from a pose (4, 4) and joints (n,) at which the arm stands. Or raise."""
        finite = np.isfinite(pose).all() and np.isfinite(q).all() and math.isfinite(now)
        if not finite or np.shape(pose) != (4, 4) or np.shape(q) != (self.chain.n,):
            raise BadCommand("start position", "is not finite", "wait for joint states")
        self._last = _Last(now, np.array(pose, float), np.array(q, float), self.limits.period, self._rest())
        self._now, self.tripped, self._let_go = now, "", math.nan

    def allow_release(self, now: float) -> None:
        """For a second from ``now`` [s], pass only setpoints that go back to the tool, whatever the force."""
        self._let_go = now

    def close(self, why: str) -> None:
        """Let nothing through from now on."""
        self.tripped = self.tripped or why

    def check(self, setpoint: ArmSetpoint, sensors: SensorReadings, now: float) -> ArmSetpoint:
        """The setpoint, if it may be sent now [s]. Raises LateInput for a late input, BadCommand for all else."""
        if self.tripped or self._last is None:
            raise BadCommand(
                "setpoint", f"the safety monitor has tripped ({self.tripped})", "clear the cause, then activate again"
            )
        try:
            with np.errstate(all="ignore"):  # numbers that overflow fail every comparison below
                self._check_time(now)
                self._check_sensors(sensors, now)
                self._check_form(setpoint)
                self._last = self._check_motion(setpoint, sensors, now, self._last)
        except LateInput:
            raise
        except BadCommand as error:
            self.tripped = str(error)
            raise
        return setpoint

    def _rest(self) -> tuple[Array, Array, Array]:
        return np.zeros(3), np.zeros(3), np.zeros(self.chain.n)

    def _check_time(self, now: float) -> None:
        if not (math.isfinite(now) and now >= self._now):
            raise BadCommand("clock", "moved backwards", "restart the node")
        self._now = now

    def _check_sensors(self, sensors: SensorReadings, now: float) -> None:
        limits = self.limits
        needed = [("joint_states", sensors.joints_stamp), ("wrench", sensors.wrench_stamp)]
        letting_go = 0.0 <= now - self._let_go <= _LETTING_GO
        for what, stamp in needed[:1] if letting_go else needed:
            if not math.isfinite(stamp):
                raise BadCommand(what, "its stamp is not finite", "check its publisher")
            if not abs(now - stamp) <= limits.timeout:
                age, limit = abs(now - stamp), limits.timeout
                raise LateInput(
                    what, f"is {age:.3g} s off, {limit:g} s is the limit", "check that its publisher is alive"
                )
        for name in self.chain.names:
            if not math.isfinite(sensors.joints.get(name, math.nan)):
                raise BadCommand(f"joint_states of {name}", "are missing or not finite", "publish every joint")
        _require_rotation("measured tool", sensors.T_base_tool)
        if letting_go:
            return
        if sensors.wrench_frame != self.chain.tip:
            said = f"is in frame '{sensors.wrench_frame}', not '{self.chain.tip}'"
            raise BadCommand("wrench", said, "transform it first")
        _require_finite("wrench", sensors.wrench, (6,))
        if (refused := self.overload(sensors.wrench)) is not None:
            raise refused

    def overload(self, wrench: Array) -> BadCommand | None:
        """Refusal of a force and moment (6,) on the tool beyond their limits; None within them."""
        force, moment = _norm(wrench[:3]), _norm(wrench[3:])
        if not force <= self.limits.force:
            said = f"{force:.1f} N, {self.limits.force:g} N is the limit"
            return BadCommand("force", said, "check what blocks the object")
        if not moment <= self.limits.moment:
            said = f"{moment:.1f} N m, {self.limits.moment:g} N m is the limit"
            return BadCommand("moment", said, "check what blocks the object")
        return None

    def _check_form(self, setpoint: ArmSetpoint) -> None:
        chain, limits = self.chain, self.limits
        if setpoint.frame != chain.base:
            raise BadCommand(
                "setpoint", f"is in frame '{setpoint.frame}', not '{chain.base}'", "give it in the base link"
            )
        if setpoint.names != chain.names:
            raise BadCommand(
                "setpoint", "has different joints than the arm", "use the chain's joint names, in its order"
            )
        n = chain.n
        for what, array, shape in (
            ("pose", setpoint.pose, (4, 4)),
            ("joints", setpoint.q, (n,)),
            ("joint speeds", setpoint.velocity, (n,)),
            ("wrench", setpoint.wrench, (6,)),
            ("stiffness", setpoint.stiffness, (6,)),
        ):
            _require_finite(f"setpoint's {what}", array, shape)
        _require_rotation("setpoint's pose", setpoint.pose)
        for what, array, (way, turn) in (
            ("wrench", np.abs(setpoint.wrench), limits.wrench),
            ("stiffness", setpoint.stiffness, limits.stiffness),
        ):
            if not (array.min() >= 0.0 and array[:3].max() <= way and array[3:].max() <= turn):
                raise BadCommand(f"setpoint's {what}", f"is not within 0 and {way:g}, {turn:g}", "ask for less")

    def _check_motion(self, setpoint: ArmSetpoint, sensors: SensorReadings, now: float, last: _Last) -> _Last:
        limits, chain = self.limits, self.chain
        out = (setpoint.q < chain.lower) | (setpoint.q > chain.upper)
        if out.any():
            j = int(np.argmax(out))
            said = f"{setpoint.q[j]:.4f} is outside {chain.lower[j]:.4f} to {chain.upper[j]:.4f}"
            raise BadCommand(f"setpoint of joint {chain.names[j]}", said, "check the arc")
        dt = now - last.now
        rates, before = last.rates, last.dt
        if dt > _PAUSE * limits.period:  # it stood meanwhile, and begins with one step
            rates, dt, before = self._rest(), limits.period, limits.period
        if not dt > 0.0:
            raise BadCommand("setpoint", "has the same stamp as the one before", "wait for the clock")
        new = (
            (setpoint.pose[:3, 3] - last.pose[:3, 3]) / dt,
            _turn(last.pose, setpoint.pose) / dt,
            (setpoint.q - last.q) / dt,
        )
        slows = now <= self._slows_until
        fastest = np.maximum(limits.joint_speed, np.abs(rates[2])) if slows else limits.joint_speed
        # neither over this step nor over the middle of two
        span = min(dt, 0.5 * (dt + before))
        for what, now_, then, speed, change in (
            ("tool", new[0], rates[0], limits.speed, limits.acceleration),
            ("turning tool", new[1], rates[1], limits.angular_speed, limits.angular_acceleration),
        ):
            _require_most(f"speed of the {what}", _norm(now_), max(speed, _norm(then)) if slows else speed)
            _require_most(f"acceleration of the {what}", _norm(now_ - then) / span, change)
        if not math.isnan(self._let_go):
            T, way, turning = sensors.T_base_tool, limits.acceleration, limits.angular_acceleration
            lead, brake = last.pose[:3, 3] - T[:3, 3], _BRAKES * span
            _require_back("setpoint", lead, new[0], rates[0], _AT_TOOL[0], brake * way)
            _require_back("turn of the setpoint", _turn(T, last.pose), new[1], rates[1], _AT_TOOL[1], brake * turning)
        for what, values, most in (
            ("speed", np.abs(new[2]), fastest),
            ("named speed", np.abs(setpoint.velocity), fastest),
            ("acceleration", np.abs(new[2] - rates[2]) / span, limits.joint_acceleration),
        ):
            j = int(np.argmax(values / most))
            _require_most(f"{what} of joint {chain.names[j]}", float(values[j]), float(most[j]))
        way, turn = speeds(sensors.T_base_tool, setpoint.pose)
        _require_most("distance of the setpoint from the tool", way, limits.displacement)
        _require_most("turn of the setpoint from the tool", turn, limits.rotation)
        T, J = pose_and_jacobian(chain, setpoint.q)
        way, turn = speeds(T, setpoint.pose)
        _require_most("distance of the pose from where the joints put it", way, limits.consistency)
        _require_most("turn of the pose from where the joints put it", turn, 5.0 * limits.consistency)
        if chain.n >= 6:
            self._check_gain(J)
        return _Last(now, np.array(setpoint.pose), np.array(setpoint.q), dt, new)

    def _check_gain(self, J: Array) -> None:
        A = J @ J.T
        try:  # J Jᵀ − g² I has a Cholesky factor where every singular value is above g; that is quicker to find
            np.linalg.cholesky(A - self._least)
        except np.linalg.LinAlgError:
            gain = math.sqrt(max(float(np.linalg.eigvalsh(A)[0]), 0.0))
            said = f"its smallest gain is {gain:.3g}, {self.limits.gain:g} is the limit"
            raise BadCommand("posture", f"is next to singular: {said}", "approach from another posture") from None


def _require_most(what: str, value: float, most: float) -> None:
    if not value <= most * (1.0 + _ROUNDING):
        raise BadCommand(what, f"{value:.4g}, {most:.4g} is the limit", "slow down, or check what computes it")


def _require_back(what: str, lead: Array, now: Array, before: Array, near: float, brake: float) -> None:
    """A motion (3,) that leads no farther from the tool than lead (3,), or brakes: speeds now and before, each (3,)."""
    far = _norm(lead)
    if far > near and not float(now @ lead) / far <= max(float(before @ lead) / far - brake, 0.0) + _ROUNDING:
        raise BadCommand(what, "moves away from the tool during release", "bring it back to where the tool is")


def _require_finite(what: str, array: Array, shape: tuple[int, ...]) -> None:
    if np.shape(array) != shape or not np.isfinite(array).all():
        raise BadCommand(what, f"is not {shape} finite numbers", "check what computes it")


def _require_rotation(what: str, T: Array) -> None:
    _require_finite(what, T, (4, 4))
    R = T[:3, :3]
    if not (np.abs(R @ R.T - _I).max() <= 1e-6 and R[:, 0] @ crossed(R[:, 1], R[:, 2]) > 0.0):
        raise BadCommand(what, "is not a rotation", "check what computes it")
    if not (T[3] == (0.0, 0.0, 0.0, 1.0)).all():
        raise BadCommand(what, "is not a rigid transform", "check what computes it")


def _turn(before: Array, after: Array) -> Array:
    """Rotation vector (3,) [rad] of a small turn, in the base."""
    D = after[:3, :3] @ before[:3, :3].T
    _, angle = speeds(before, after)
    v = np.array([D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]])
    length = math.sqrt(v @ v)
    return v * (angle / length) if length > 0.0 else np.array([angle, 0.0, 0.0])


def _norm(v: Array) -> float:
    return math.sqrt(v @ v)

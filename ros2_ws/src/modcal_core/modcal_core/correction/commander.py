"""What stands between a desired pose and an arm: a calibration in use, limits, speeds, no jump when it changes.

What to command so that the arm's tool truly comes to be where it is wanted.

The calibrated geometry gives a posture near the seed. From there Newton's method goes on with the whole prediction, its
derivatives taken by differences: loads, gears and play are then those of the posture itself, and a gear error that is
steep (amplitude times cycles of some hundredths) is no slower than a flat one. Play is on the side that each joint will
have come from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from modcal_core.calibration import Calibration
from modcal_core.correction.correction import ArmState, Correction, Target
from modcal_core.errors import BadCommand, NotReachable
from modcal_core.geometry import Array, descend, se3
from modcal_core.robots import (
    Delta,
    Mechanism,
    calibrated_urdf,
    delta_inverse,
    inverse,
    is_delta,
    is_serial_arm,
    read_chain,
)

TOLERANCE_M, TOLERANCE_RAD = 1e-7, 1e-7
_DIFFERENCE = 1e-6  # rad or m
_MAX_STEPS = 12
_EFFECTS_M, _EFFECTS_RAD = 5e-3, 2e-2  # what effects may add to the reach of an arm
_RESTARTS = 12  # each takes some ten milliseconds where there is nothing to be found
_TILTED = 0.05  # rad; a Delta's platform stays level, and what is asked beyond its own errors is refused
_SINGULAR = 1e-3  # smallest gain of the joints, m or rad a rad, that still counts as one

_Posture = tuple[Array, Array, Array]  # joint positions, the error there, and what it loses per unit of each joint


@dataclass(frozen=True)
class Command:
    """A posture to command. q: joint positions (n,). position [m], rotation [rad]: what it misses by prediction.

    steps: of Newton's method. unseen: joints that it takes where the calibration has never seen them. singular: whether
    the arm can hardly move there in some direction.
    """

    q: Array
    position: float
    rotation: float
    steps: int
    unseen: tuple[str, ...]
    singular: bool


def compensate(
    correction: Correction,
    desired: Array,
    seed: Array,
    at: ArmState,
    target: Target = "tip",
    frame: str = "",
    rng: np.random.Generator | None = None,
    tolerance_m: float = TOLERANCE_M,
    tolerance_rad: float = TOLERANCE_RAD,
) -> Command:
    """The command that brings tip or tool to a true pose (4, 4), in the base link or in a tracker frame.

    seed: posture (n,) near which it is sought. at: the present conditions; the arm arrives from ``at.q``. rng: draws
    other postures to begin from where the seed leads nowhere; without it the answer is near the seed or there is none.
    Raises NotReachable, MissingDriver, BadTable (unknown frame).
    """
    correction.require(at)
    chain = correction.chain
    level = desired if not frame else se3.inverse(correction.base_in(frame)) @ desired
    # where the tip would be wanted in the base link if geometry were all
    goal = level if target == "tip" else level @ se3.inverse(correction.model.T_tip_tool)
    if is_serial_arm(chain):
        try:
            q = inverse(chain, goal, seed, rng=rng, restarts=_RESTARTS, tolerance=1e-7)
        except NotReachable as plain:  # an arm may be longer, or a joint farther from its limit, than by geometry
            if not (plain.position < _EFFECTS_M and plain.rotation < _EFFECTS_RAD):
                raise
            q = plain.posture
    else:
        assert is_delta(chain)
        q = _of_delta(chain, goal, seed)
    # which side a joint comes from is settled by the plain way there, and once: play must not flip to and fro
    arriving = at.arriving(q)
    controlled = correction.controlled(level).T

    def linearised(q: Array) -> tuple[Array, Array]:
        """The error at a command (n,), seen from the target, and what it loses per unit of each joint.

        (6,) and (6, n); of a Delta only what its joints can do away with.
        """
        postures = q + np.concatenate([np.zeros((1, len(q))), _DIFFERENCE * np.eye(len(q))])
        errors = se3.error(correction.poses(postures, arriving, target, frame), desired) @ controlled
        return errors[0], -(errors[1:] - errors[0]).T / _DIFFERENCE

    enough = 0.01 * min(tolerance_m, tolerance_rad)

    def step(here: _Posture, damping: float) -> tuple[_Posture, float]:
        q, error, J = here
        full = J.T @ np.linalg.solve(J @ J.T + damping * np.eye(len(error)), error)
        new = np.clip(q + full, chain.lower, chain.upper)
        there = new, *linearised(new)
        return there, _size(there[1])

    begin: _Posture = q, *linearised(q)
    steps = 0
    if _size(begin[1]) > enough:
        found = descend(begin, lambda here: _size(here[1]), step, lambda here, *_: _size(here[1]) <= enough, _MAX_STEPS)
        begin, steps = found.place, found.steps
    q, error, J = begin
    position, rotation = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
    if not is_serial_arm(chain):
        left = se3.error(correction.poses(q[None], arriving, target, frame), desired)[0, 3:]
        if float(np.linalg.norm(left)) > _TILTED:
            said = f"the platform cannot turn so: {np.degrees(np.linalg.norm(left)):.1f}° are left"
            raise NotReachable("desired pose", said, "ask for a level tool, turned about the base's z", 0.0)
    if not (position <= tolerance_m and rotation <= tolerance_rad):
        x, y, z = desired[:3, 3]
        raise NotReachable(
            f"true pose of the {target} at ({x:.3f}, {y:.3f}, {z:.3f}) m in {frame or chain.base}",
            f"the best command found misses it by {1e3 * position:.3g} mm, {rotation:.3g} rad",
            "stay away from singular postures and joint limits, or approach from another side",
            position,
            rotation,
        )
    gains = np.linalg.svd(J, compute_uv=False)
    return Command(q, position, rotation, steps, correction.unseen(q), bool(gains[min(J.shape) - 1] < _SINGULAR))


def _of_delta(chain: Delta, goal: Array, seed: Array) -> Array:
    """The posture of a Delta with its tip at a pose's place, turned about z as it is, as near to the seed as may be."""
    yaw = float(np.arctan2(goal[1, 0], goal[0, 0]))
    if chain.has_shaft:
        now = chain.shaft_ratio * float(seed[-1])
        yaw += 2.0 * np.pi * round((now - yaw) / (2.0 * np.pi))
        low, high = sorted(chain.shaft_ratio * np.array([chain.lower[-1], chain.upper[-1]]))
        yaw += 2.0 * np.pi * (int(yaw < low) - int(yaw > high))
    return delta_inverse(chain, goal[:3, 3], yaw if chain.has_shaft else 0.0)


def _size(error: Array) -> float:
    return float(np.linalg.norm(error))


_MIN_SECONDS = 0.1  # even the shortest way to a goal gets this long
_STREAM_ENDS = 0.5  # s without a setpoint, and nothing is streamed any more


@dataclass(frozen=True)
class Bounds:
    """What the arm may be told. lower, upper: [rad or m], (n,). speed: [rad/s or m/s], (n,)."""

    names: tuple[str, ...]
    lower: Array
    upper: Array
    speed: Array

    @classmethod
    def of(cls, chains: Sequence[Mechanism], turning: float, sliding: float) -> Bounds:
        """The limits that all descriptions of one arm allow; speeds of its turning and its sliding joints."""
        first = chains[0]
        return cls(
            first.names,
            np.max([chain.lower for chain in chains], axis=0),
            np.min([chain.upper for chain in chains], axis=0),
            np.where(first.revolute, turning, sliding),
        )

    def require_within(self, q: Array) -> None:
        """Raises BadCommand unless these positions (n,) are finite and within the limits."""
        if not np.isfinite(q).all():
            raise BadCommand("joint command", "is not finite", "a fault of modcal: report it with the calibration")
        out = (q < self.lower) | (q > self.upper)
        if out.any():
            j = int(np.argmax(out))
            raise BadCommand(
                f"command {q[j]:.4f} of joint {self.names[j]}",
                f"its limits are {self.lower[j]:.4f} to {self.upper[j]:.4f}",
                "ask for a pose that the arm reaches within its limits",
            )

    def require_step(self, q: Array, now: Array, seconds: float) -> None:
        """Raises BadCommand unless the joints can get from ``now`` to q (n,) in this time [s]."""
        share = np.abs(q - now) / (self.speed * seconds)
        j = int(np.argmax(share))
        if not share[j] <= 1.0:
            raise BadCommand(
                f"step of joint {self.names[j]}",
                f"{abs(q[j] - now[j]):.4f} in {seconds:g} s is faster than {self.speed[j]:g} per second",
                "move the desired pose in smaller steps, or give more time (horizon_s)",
            )

    def seconds(self, q: Array, now: Array) -> float:
        """Time from ``now`` to q (n,) at full speed [s]."""
        return max(float((np.abs(q - now) / self.speed).max()), _MIN_SECONDS)


class SetpointStream:
    """The setpoints of one stream, kept free of jumps when the calibration behind them changes."""

    def __init__(self) -> None:
        self._last: tuple[float, Array] | None = None
        self._offset: tuple[float, float, Array] | None = None

    def running(self, now: float) -> bool:
        """Whether a setpoint was given lately, at time ``now`` [s]."""
        return self._last is not None and 0.0 <= now - self._last[0] < _STREAM_ENDS

    def take_over(self, q: Array, now: float, most: float, blend: float) -> None:
        """From now on come commands that begin at q (n,) instead of the last setpoint.

        The difference is faded out over ``blend`` [s].
        Raises BadCommand, and changes nothing, if any joint would have to make up for more than ``most`` [rad or m].
        """
        if not self.running(now) or self._last is None:
            self._offset = None
            return
        offset = self._last[1] - q
        largest = float(np.abs(offset).max())
        if not largest <= most:
            raise BadCommand(
                "new calibration in the middle of a stream",
                f"it moves a joint by {largest:.4f}, {most:g} is allowed",
                "it is applied when the stream pauses",
            )
        self._offset = (now, blend, offset)

    def setpoint(self, q: Array, now: float) -> Array:
        """The setpoint (n,) for a command q (n,) at time ``now`` [s]; :meth:`given` makes it the last one."""
        if self._offset is not None and self.running(now):
            since, blend, offset = self._offset
            share = (now - since) / blend if blend > 0.0 else 1.0
            if 0.0 <= share < 1.0:
                return q + offset * (1.0 - share**2 * (3.0 - 2.0 * share))
        self._offset = None
        return q

    def given(self, q: Array, now: float) -> None:
        """Note that this setpoint (n,) was sent."""
        self._last = (now, q)

    def reset(self) -> None:
        """Start over."""
        self._last = self._offset = None


_SEED = 1  # of the postures that a goal is also sought from: the same goal gets the same answer


@dataclass(frozen=True)
class CommanderSettings:
    """target: what poses are of. stream: every pose is a setpoint for ``horizon`` [s] ahead. turning, sliding: speeds
    of joints [rad/s, m/s]. tolerance_m, tolerance_rad: of the prediction. switch_step: of a joint, by a new calibration
    in a stream [rad or m], which comes in over ``blend`` [s].
    """

    target: Target = "tip"
    stream: bool = False
    horizon: float = 0.1
    turning: float = 0.5
    sliding: float = 0.1
    tolerance_m: float = 1e-6
    tolerance_rad: float = 1e-6
    switch_step: float = 2e-3
    blend: float = 1.0


@dataclass(frozen=True)
class CalibratedRobot:
    """A calibration that fits the robot that is there. farthest: no desired position lies farther off [m]."""

    correction: Correction
    described: Mechanism
    farthest: float

    @classmethod
    def of(cls, calibration: Calibration, description: str | Delta) -> CalibratedRobot:
        """The robot of a URDF, or a Delta, and its calibration. Raises BadRobot where they do not belong together."""
        nominal = calibration.nominal.chain
        chain: Mechanism
        chain = description if is_delta(description) else read_chain(str(description), nominal.base, nominal.tip)
        calibration.require_robot(chain)
        model = calibration.calibrated
        away = max(float(np.linalg.norm(T[:3, 3])) for T in model.T_frame_base)
        ends = np.linalg.norm(chain.T_base_root[:3, 3]) + np.linalg.norm(model.T_tip_tool[:3, 3])
        return cls(Correction(calibration), chain, 1.05 * (chain.reach() + away + float(ends)))

    def bounds(self, settings: CommanderSettings) -> Bounds:
        """What both the description and the calibration allow."""
        return Bounds.of((self.described, self.correction.chain), settings.turning, settings.sliding)


@dataclass(frozen=True)
class JointSetpoint:
    """What to send. q: joint positions (n,). seconds: when to be there. command: what it was computed as."""

    q: Array
    seconds: float
    command: Command


@dataclass
class Commander:
    """The robot in use, one that waits for its turn, and the stream of setpoints."""

    settings: CommanderSettings = field(default_factory=CommanderSettings)
    robot: CalibratedRobot | None = None
    waiting: CalibratedRobot | None = None
    _stream: SetpointStream = field(default_factory=SetpointStream)
    _wish: tuple[Array, str] | None = None

    def use(self, robot: CalibratedRobot, now: float) -> bool:
        """Correct with this calibration from now on; whether that is so, or it must wait for the stream to pause."""
        self.waiting = robot
        if self.robot is None or not self._stream.running(now):
            self.robot, self.waiting = robot, None
        return self.waiting is None

    def drop(self) -> None:
        """Correct nothing from now on."""
        self.robot = self.waiting = self._wish = None
        self._stream.reset()

    def paused(self, now: float) -> None:
        """Let a calibration that waits take part if nothing streams any more."""
        if self.waiting is not None and not self._stream.running(now):
            self.robot, self.waiting = self.waiting, None

    def change_over(self, at: ArmState, now: float) -> None:
        """Let a calibration that waits take part: at once where nothing streams, else from where the stream is.

        Raises ModcalError, and lets it wait on, when the stream would jump.
        """
        if self.waiting is None or self.robot is None:
            return
        if self._stream.running(now) and self._wish is not None:
            command = self._solve(self.waiting, *self._wish, at, wide=False)
            self._stream.take_over(command.q, now, self.settings.switch_step, self.settings.blend)
        self.robot, self.waiting = self.waiting, None

    def setpoint(self, desired: Array, frame: str, at: ArmState, now: float) -> JointSetpoint:
        """The setpoint for a desired true pose (4, 4) in a frame, "" for the base link, from the posture ``at.q``.

        Raises ModcalError for what the arm must not follow.
        """
        if self.robot is None:
            raise BadCommand("desired_pose", "no command is corrected", "provide a valid calibration first")
        robot, settings = self.robot, self.settings
        frame = "" if frame == robot.correction.chain.base else frame
        command = self._solve(robot, desired, frame, at, wide=not settings.stream)
        bounds = robot.bounds(settings)
        q = self._stream.setpoint(command.q, now) if settings.stream else command.q
        bounds.require_within(q)
        if not settings.stream:
            return JointSetpoint(q, bounds.seconds(q, at.q), command)
        bounds.require_step(q, at.q, settings.horizon)
        self._wish = desired, frame
        return JointSetpoint(q, settings.horizon, command)

    def sent(self, setpoint: JointSetpoint, now: float) -> None:
        """Note that a setpoint went out."""
        if self.settings.stream:
            self._stream.given(setpoint.q, now)

    def _solve(self, robot: CalibratedRobot, desired: Array, frame: str, at: ArmState, wide: bool) -> Command:
        settings = self.settings
        rng = np.random.default_rng(_SEED) if wide else None
        within = settings.tolerance_m, settings.tolerance_rad
        command = compensate(robot.correction, desired, at.q, at, settings.target, frame, rng, *within)
        if command.singular and not wide:
            raise BadCommand("desired_pose", "the arm is singular there", "route the stream around it, or send a goal")
        return command


def corrected_urdf(robot: CalibratedRobot, description: str) -> str:
    """The URDF with the calibrated geometry in it; "" for a Delta, which has none. Raises ModcalError."""
    if not is_serial_arm(robot.described):
        return ""
    return calibrated_urdf(description, robot.described, robot.correction.model.serial)


def finite(*arrays: Array) -> None:
    """Raises BadCommand unless all numbers are finite: nothing else may reach an arm."""
    if not all(np.isfinite(a).all() for a in arrays):
        raise BadCommand("corrected pose", "is not finite", "calibrate again")

"""A robot with the calibration in use, and what a desired pose must pass to become a command for it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from modcal_core.calibration import Calibration
from modcal_core.correction.compensation import Command, compensate
from modcal_core.correction.correction import ArmState, Correction, Target
from modcal_core.correction.setpoints import Bounds, SetpointStream
from modcal_core.errors import BadCommand
from modcal_core.geometry import Array
from modcal_core.robots import Delta, Mechanism, calibrated_urdf, is_delta, is_serial_arm, read_chain

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

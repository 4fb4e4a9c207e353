"""Opening something, as a story: weigh the tool, pull gently, learn, look whether the way is free, follow it, stop.

    tare → explore → check → follow → arrive → done
                  ↘ release → stopped: whenever something is not as it should be

One tick a period, no clock of its own, no ROS. What comes out of a tick has passed the guard; a tick never raises for
anything that it was given.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from modcal_core.articulation import JointModel
from modcal_core.errors import BadCommand, ModcalError
from modcal_core.geometry import Array, relative, speeds
from modcal_core.impedance import tare
from modcal_core.impedance.impedance import Impedance
from modcal_core.impedance.joint_force import ArmEfforts, FreeMotion
from modcal_core.impedance.path_model import Exploration, PathCheck, PathModel, Reach
from modcal_core.impedance.safety_monitor import ArmSetpoint, LateInput, Limits, SafetyMonitor, SensorReadings
from modcal_core.impedance.setpoint_filter import SetpointFilter
from modcal_core.impedance.speed_governor import InputWatch, SpeedGovernor
from modcal_core.impedance.task import ImpedanceTask, JointPositions, ObjectModel, Stop, Wait
from modcal_core.impedance.tool_force import ToolForce
from modcal_core.impedance.wrench import WrenchSensor
from modcal_core.robots import Chain

_USUAL, _LONGEST = 0.6, 1.9  # s; after a second the safety monitor forbids what goes beyond its limits, as ever
_LATELY = 0.1  # s over which it is seen whether the tool still moves
_STANDS = 2e-5  # m by which it then still moves at most: what 8 N do that unwind within two seconds, on stiff fingers


_STOOD = 2e-3  # m/s at which the tool has arrived
_CHECK_PATIENCE = 5.0  # s
_STEPS_A_TICK = 2  # of the walk along the way that is to be checked
_MEASURED_EVERY = 4  # ticks, after which it is looked anew how far it is open: some tenths of a millimetre
_SURELY = 0.01  # of the way that is gone beyond the goal, so that it is surely reached
_STAND_PATIENCE = 2.0  # s
_MOVING = ("explore", "check", "follow")  # phases in which the hand is led
_MODEL_MOVED = 0.015, 0.04  # m, rad by which a goal may move before its way is looked at anew


class Operation:
    """One pull at one object. Tick it until a tick says Stop, or :meth:`stop` it. tool_force: what is felt."""

    def __init__(self, chain: Chain, task: ImpedanceTask, limits: Limits, softest: Array | None = None,
                 efforts: ArmEfforts | None = None, motion: FreeMotion | None = None) -> None:  # fmt: skip
        """For an arm (chain to the tool that is measured). softest (n,): stiffness of its joints at least [N m/rad].

        efforts: what is known of those that its joints report. motion: what they reported before it took hold.
        """
        self.chain, self.task, self.limits = chain, task, limits
        self.phase = "tare"
        self.monitor = SafetyMonitor(chain, limits)
        self.setpoint_filter = SetpointFilter(chain, limits)
        self.impedance = Impedance(task.gains(task.direction), task.blend)
        self.governor = SpeedGovernor(task.governor)
        self.tool_force = ToolForce(chain.n, task, limits, softest, efforts)
        self.reached: Reach | None = None
        self.course: PathModel | None = None
        self.expected = self._measured = np.eye(4)
        self._pull: Exploration | None = None
        self._tare, self._motion = tare.TarePhase(task.tare_s, task.gravity, task.wrench == "sensor"), motion
        self._path_check: tuple[PathCheck, Array] | None = None
        self._checked = np.eye(4)
        self._walked_from = 0.0
        self._untrusted, self._late = 0.0, False
        self._why, self._since = "", math.nan
        self._released: deque[tuple[float, Array]] = deque()  # s of the release, and where the tool was (3,) [m]
        self._last = -math.inf
        self._ticks = 0
        self._at: float | None = None
        self._watch = InputWatch(limits.timeout)
        self._stop: Stop | None = None
        self._tell: dict[str, Callable[[float, Array, ObjectModel], None]] = {
            "explore": self._explore,
            "check": self._check,
            "follow": self._follow,
            "arrive": self._arrive,
            "release": self._release,
        }

    @property
    def force(self) -> Array:
        """The wrench (6,) that is felt on the tool, in its axes."""
        return self.tool_force.felt

    def stop(self, why: str) -> Stop:
        """End it now, whatever it does; what is let go says why it was."""
        why = self._why or why
        self.monitor.close(why)
        self._stop = self._stop or Stop(False, why, self._opened())
        return self._stop

    def release(self, why: str, now: float) -> None:
        """Begin to let go of it at time ``now`` [s]; some more ticks do so, and then say Stop."""
        if self.phase == "tare":  # nothing was sent yet
            self.stop(why)
        elif self.phase != "release" and self._stop is None:
            self._let_go(why, now)

    def restrict(self, task: ImpedanceTask, limits: Limits, now: float) -> None:
        """Keep to other limits and speeds from time ``now`` [s] on; of the task, nothing else changes.

        What is too fast for them brakes. A hand that they do not allow to be where it is lets go, by those of before.
        """
        self.task = replace(
            self.task, speed=task.speed, exploration_speed=task.exploration_speed, governor=task.governor
        )
        self.governor.settings = task.governor
        lead, turned = speeds(self._measured, self.setpoint_filter.pose) if self.phase != "tare" else (0.0, 0.0)
        why = ""
        if lead > limits.displacement or turned > limits.rotation:
            why = f"the setpoint is {1e3 * lead:.0f} mm and {math.degrees(turned):.0f}° from the tool"
        elif self.phase != "tare" and self.monitor.gain_at(self.setpoint_filter.q) < limits.gain:
            why = "the posture is next to singular"
        if why:
            kept = self.limits
            limits = replace(limits, displacement=kept.displacement, rotation=kept.rotation, gain=kept.gain)
        self.limits, self._watch.timeout = limits, limits.timeout
        self.tool_force.restrict(self.task, limits)
        self.monitor.restrict(limits, now)
        self.setpoint_filter.limits = limits
        if why and self.phase != "release":
            self._let_go(f"limits were changed: {why}", now)

    def tick(
        self, now: float, T_base_tool: Array, sensor: WrenchSensor, joints: JointPositions, state: ObjectModel
    ) -> ArmSetpoint | Wait | Stop:
        """What to send at time ``now`` [s], or that nothing may be sent yet, or any more.

        T_base_tool (4, 4): where the tool is measured. sensor: has the last wrench. state: the estimate so far.
        """
        if self._stop is not None:
            return self._stop
        try:
            needed = {"joint_states": joints.stamp}
            if self.phase != "release" and self.task.wrench == "sensor":
                needed["wrench"] = sensor.stamp
            late = self._watch.late(now, needed)
            if late and self.phase != "tare" and self._watch.waited(now, self.task.input_timeout_s):
                if self._watch.fresh(joints.stamp, now):  # which is enough to let go
                    self._let_go(late, now)
                elif self._watch.recoverable(now):
                    self._watch.pending = self._why or late
                    return Wait(f"{late}; what is held is let go when they return")
                else:
                    return self.stop(late)
            elif late:
                return self._wait(late, now)
            elif self._watch.pending:
                self._let_go(self._watch.pending, now)
            self._watch.all_fresh()
            if self.phase == "tare":
                return self._weigh(now, T_base_tool, sensor, joints, state)
            return self._go_on(now, T_base_tool, sensor, joints, state)
        except LateInput as error:
            return self._wait(str(error), now)
        except ModcalError as error:
            return self.stop(str(error))

    def _wait(self, why: str, now: float) -> Wait | Stop:
        self._watch.wait(now)
        patience = self.task.input_timeout_s if self.phase != "tare" else tare.PATIENCE
        return self.stop(why) if self._watch.waited(now, patience) else Wait(why)

    def _weigh(
        self, now: float, T: Array, sensor: WrenchSensor, joints: JointPositions, state: ObjectModel
    ) -> Wait | Stop:
        self.tool_force.efforts.rest(joints)
        over, why = self._tare.step(now, T, sensor, joints, state.silent)
        if why:
            return self.stop(why) if over else Wait(why)
        self.setpoint_filter.begin(joints.q, T)
        if why := self.tool_force.begin(self.setpoint_filter.jacobian, self._motion, sensor.load.mass):
            return self.stop(why)
        self.monitor.open(T, joints.q, now)
        self._pull = Exploration(T, self.task.direction, self.task.exploration_speed)
        self.expected = T
        self._watch.start_motion(now)
        self._enter("explore", now)
        return Wait("the wrench is tared")

    def _go_on(
        self, now: float, T: Array, sensor: WrenchSensor, joints: JointPositions, state: ObjectModel
    ) -> ArmSetpoint | Wait | Stop:
        h = now - self._last
        if not 0.0 < h <= 5.0 * self.limits.period:  # the first, or after a pause: from rest
            if h <= 0.0:
                raise BadCommand("clock", "moved backwards or stopped", "restart the node")
            self.setpoint_filter.rest()
            self.impedance.halt()
            self.governor.stand(now)
            h = self.limits.period
            self._resume(now - h)
        self._measured = T
        told = joints.stamp if self.task.wrench == "efforts" else sensor.stamp
        self.governor.heed(max(now - joints.stamp, now - told), h)
        self.tool_force.take(now, T, sensor, joints, self.setpoint_filter, self.governor.braking)
        refused = self.monitor.overload(self.tool_force.sure) or self.tool_force.overload()
        if refused is None and self.phase in _MOVING:
            refused = self.tool_force.refused(T, joints, self.setpoint_filter)
        lost = self.phase in _MOVING and self._watch.estimator_lost(state.silent, now, self.task.input_timeout_s)
        if (refused is not None or lost) and self.phase != "release":
            self._let_go(str(refused or lost), now)
        self._late = state.late
        self._tell[self.phase](h, T, state)
        if self._stop is not None:
            return self._stop
        if self.phase == "release":
            goal = self.expected = T
        elif self.task.mode == "admittance" and self.phase != "arrive":
            sure = self.tool_force.sure
            F = np.concatenate([relative(self.expected, T, sure[:3]), relative(self.expected, T, sure[3:])])
            caution = max(self.governor.caution, self.governor.damping / self.task.damping[0])
            self.impedance.step(F, h, caution)
            goal = self.impedance.command(self.expected)
        else:
            goal = self.expected
        self.setpoint_filter.step(goal, h, self._posture())
        self.tool_force.sent(self.setpoint_filter, now)
        self._last = now
        positions = dict(zip(self.chain.names, joints.q.tolist(), strict=True))
        heard = SensorReadings(positions, joints.stamp, T, self.tool_force.sure, self.chain.tip, told)
        return self.monitor.check(self._setpoint(), heard, now)

    def _resume(self, before: float) -> None:
        """Go on from a time [s] as if it were that of the last tick: of a phase's time, a pause is none."""
        if self._since <= self._last:
            self._since += before - self._last
        self._last = before
        if self.phase == "release":
            self.monitor.allow_release(before)

    def _explore(self, h: float, T: Array, state: ObjectModel) -> None:
        pull, now = self._pull, self._last + h
        assert pull is not None
        ds = self._go(self.task.exploration_speed, h, self.tool_force.exploring_speed(pull.progress(T)))
        sent = self.setpoint_filter.pose if self.task.mode == "admittance" else None
        self.expected = pull.advance(ds, T, h, sent)
        self.impedance.align(self.expected[:3, :3].T @ pull.moved)
        lead = math.dist(self.expected[:3, 3], T[:3, 3])
        if state.trusted and state.model is not None:
            self._believe(state.model, T)
            self._enter("check", now)
        elif self.governor.stuck(pull.progress(T), lead, self.force, now):
            self._let_go(f"it does not move: {self._pushed()} and {1e3 * pull.progress(T):.0f} mm so far", now)
        elif pull.way - lead > self.task.max_exploration:
            said = state.event or "no model predicts it"
            self._let_go(f"motion not identified after {100.0 * pull.progress(T):.0f} cm ({said})", now)

    def _check(self, h: float, T: Array, state: ObjectModel) -> None:
        course, now = self.course, self._last + h
        assert course is not None
        self.expected = course.advance(self._go(0.0, h))
        done = self._look(_STEPS_A_TICK)
        if done is not None:
            if done.whole:
                self.impedance.change(self.task.gains(course.tangent()))
                self._enter("follow", now)
            else:
                self._let_go(f"the arm cannot move it to the goal: {done.why}", now)
        elif now - self._since > _CHECK_PATIENCE:
            self._let_go("the path was not checked in time: this is a fault of modcal", now)

    def _follow(self, h: float, T: Array, state: ObjectModel) -> None:
        course, now = self.course, self._last + h
        assert course is not None
        if state.model is not None and state.trusted and state.model is not course.model:
            self._believe(state.model, T)
        if self._path_check is not None:
            done = self._look(1)
            if done is not None and not done.whole:
                self._let_go(f"the arm cannot move it to the goal: {done.why}", now)
                return
        self._ticks += 1
        if self._ticks % _MEASURED_EVERY == 0 or self._at is None:
            self._at = course.configuration(T)
        at = self._at
        left = course.left(at)
        force = self.tool_force
        wanted = (force.following_speed if state.trusted else force.exploring_speed)(course.way - left)
        wanted = min(wanted, math.sqrt(0.2 * max(left, 0.0)) + 0.01)
        # the arm may be slower than the way: its joints set the pace then
        wanted *= min(1.0, max(0.0, 2.0 - self.setpoint_filter.lag(self._goal_now()) / 0.005))
        ds = self._go(wanted, h)
        self.expected = course.advance(ds)
        self.impedance.align(course.tangent())
        self._untrusted = 0.0 if state.trusted else self._untrusted + ds
        if left <= -_SURELY * course.way - self._yields():
            self.expected = self.setpoint_filter.pose
            self._enter("arrive", now)
        elif self._untrusted > 0.05:
            self._let_go(f"it moves differently than before ({state.event or 'no model predicts it'})", now)
        elif self.governor.stuck(-left, course.left(at) - course.left(course.at), self.force, now):
            self._let_go(f"it stopped moving: {self._pushed()}, open to {self._said(T)}", now)

    def _arrive(self, h: float, T: Array, state: ObjectModel) -> None:
        slow = float(np.abs(self.setpoint_filter.velocity).max()) <= _STOOD
        if slow or self._last + h - self._since > _STAND_PATIENCE:
            self._stop = Stop(True, f"open to {self._said(T)}", self._opened(T))
            self.monitor.close(self._stop.why)

    def _release(self, h: float, T: Array, state: ObjectModel) -> None:
        """Expect the tool where it is: a servo that is sent where its arm already is holds against nothing.

        That is stable however late the tool is measured, and what is felt moves nothing, only a force does. A stiff arm
        on soft fingers unwinds slowly, so it takes longer while the tool still moves.
        """
        seconds, past = self._last + h - self._since, self._released
        past.append((seconds, T[:3, 3]))
        while past[0][0] < seconds - _LATELY:
            past.popleft()
        if seconds > _LONGEST or (seconds > _USUAL and math.dist(past[0][1], T[:3, 3]) <= _STANDS):
            self.stop(self._why)

    def _go(self, wanted: float, h: float, most: float = math.inf) -> float:
        """The way [m] to go on in h seconds: as fast as wanted [m/s] where nothing forbids it, and never above most.

        Without the estimator's heartbeat the hand stands still: what it leads along may be over.
        """
        if self._late:
            most = 0.0
        told = self.tool_force
        self.governor.touch(math.sqrt(self.force[:3] @ self.force[:3]), told.tool)
        along = self.impedance.gains.task[:, 0]
        sight = self.governor.in_sight(told.size, told.delay, *told.hold(along, self.setpoint_filter))
        return self.governor.step(wanted, min(most, sight), self.tool_force.foreseen, h)

    def _enter(self, phase: str, now: float) -> None:
        self.phase, self._since = phase, now

    def _let_go(self, why: str, now: float) -> None:
        self._why = why
        self.monitor.allow_release(now)
        self._enter("release", now)

    def _believe(self, model: JointModel, T: Array) -> None:
        """Follow a model from now on. The setpoint does not jump, and a changed path is checked again."""
        before, self._at = self.expected, None
        if self.course is None:
            assert self._pull is not None
            moved = T[:3, 3] - self._pull.start[:3, 3]
            goals = self.task.goal_rad, self.task.goal_m
            over = self.task.governor.max_lead  # by which the hand may yield
            self.course = PathModel(model, self._pull.start, before, moved, *goals, over)
            self.expected = self.course.pose(self.course.at)
        else:
            self.expected = self.course.take(model, before)
        if self.task.mode == "admittance":
            self.impedance.expect(before, self.expected)
        goal = self.course.pose(self.course.goal_at)
        way, turn = speeds(self._checked, goal)
        if self._path_check is None and (way > _MODEL_MOVED[0] or turn > _MODEL_MOVED[1]):
            path = self.course.path(np.linalg.inv(self.setpoint_filter.offset))
            self._path_check = PathCheck(self.chain, path, self.setpoint_filter.q, gain=1.5 * self.limits.gain), goal
            self._walked_from = self.course.opened(self.course.at)

    def _look(self, steps: int) -> Reach | None:
        """Go on looking along the way; what was found when it is done."""
        assert self._path_check is not None
        walk, goal = self._path_check
        done = walk.advance(steps)
        if done is not None:
            self.reached, self._checked, self._path_check = done, goal, None
        return done

    def _posture(self) -> Array | None:
        if self.phase in ("arrive", "release") or self.reached is None or self.course is None or not self.reached.whole:
            return None
        span = self.course.opened(self.course.goal_at) - self._walked_from
        share = (self.course.opened(self.course.at) - self._walked_from) / span if abs(span) > 1e-6 else 1.0
        return self.reached.posture(share)

    def _goal_now(self) -> Array:
        return self.impedance.command(self.expected) if self.task.mode == "admittance" else self.expected

    def _setpoint(self) -> ArmSetpoint:
        follower, task = self.setpoint_filter, self.task
        if task.mode == "admittance":
            stiffness = np.repeat(np.array(task.stack), 3)
        else:
            stiffness = np.diag(self.impedance.gains.matrices()[2]).copy()
        q, velocity, none = follower.q, follower.velocity, np.zeros(6)
        return ArmSetpoint(self.chain.base, self.chain.names, follower.pose, q, velocity, none, stiffness, self.phase)

    def _opened(self, T: Array | None = None) -> float:
        if self.course is None:
            return 0.0
        return self.course.said(self.course.configuration(self.expected if T is None else T))

    def _said(self, T: Array | None = None) -> str:
        opened = self._opened(T)
        turns = self.course is not None and self.course.turns
        return f"{math.degrees(opened):.0f}°" if turns else f"{100.0 * opened:.0f} cm"

    def _yields(self) -> float:
        """The way [m] that fingers and object may stay behind the tool, under the force that is felt."""
        return math.sqrt(self.force[:3] @ self.force[:3]) / self.task.governor.contact_stiffness

    def _pushed(self) -> str:
        return f"{math.sqrt(self.force[:3] @ self.force[:3]):.0f} N"

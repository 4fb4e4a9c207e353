"""``station_runner``: an arm measures itself until a wanted accuracy is proven. A lifecycle node."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.timer import Timer
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from modcal_core.errors import BadCommand, ModcalError
from modcal_core.geometry.so3 import Array
from modcal_core.measuring.advice import Advice
from modcal_core.measuring.motion import TimedMotion
from modcal_core.measuring.session import SKIPPED, UNSEEN
from modcal_msgs_py.commands import JointInput
from modcal_msgs_py.stamps import seconds, set_seconds
from modcal_nodes.measuring.place import Place, StationWay
from modcal_nodes.measuring.runner import HELD, IDLE, Done, Hold, JointReport, Rules, Runner, Send
from modcal_nodes.ros.declaring import declare, follow, values
from modcal_nodes.ros.guarded import GuardedNode
from modcal_nodes.ros.health import ERROR, OK, WARN, Health, Status
from modcal_nodes.ros.parameters import STATION_RUNNER
from modcal_nodes.ros.refusals import Refusals
from modcal_nodes.ros.running import FRESH, LATCHED, run
from modcal_nodes.ros.subscriptions import MonitoredSubscription, subscription_status

_STOPPING = 0.2  # s that a controller is given to stop in
_AGAIN = 2.0  # s until what was refused is tried again
_BLIND = 20  # stations in a row that the instrument does not see, after which it is asked to be looked at
_STEADY = Clock(clock_type=ClockType.STEADY_TIME)  # a simulated time that stands must not keep an arm from being held


class StationRunner(GuardedNode, LifecycleNode):
    """Moves an arm from station to station. Nothing moves at launch, and nothing before a dry run was accepted."""

    def __init__(self) -> None:
        super().__init__("station_runner")
        declare(self, STATION_RUNNER)
        self._chosen = values(self, STATION_RUNNER)
        self._thinking = ThreadPoolExecutor(1, "thinking")
        self._future: Future[Any] | None = None
        self._then: Callable[[Any], None] = lambda _: None
        self._place: Place | None = None
        self._joints: JointInput | None = None
        self._received = -np.inf
        self._runner: Runner | None = None
        self._advice: Advice | None = None
        self._summary, self._shown = "", False
        self._active = self._running = self._begun = False
        self._blind, self._again = 0, -np.inf
        self._said, self._level = "not configured", OK
        self._timer: Timer | None = None
        self._inputs: list[MonitoredSubscription] = []
        self._refusals = Refusals(self)
        self._trajectory = self.create_publisher(JointTrajectory, "~/joint_trajectory", 10)
        self._health = Health(self, self._report)
        follow(self, STATION_RUNNER, self._chosen)
        self.create_service(Trigger, "~/dry_run", self._show_dry_run)
        self.create_service(Trigger, "~/start", self._start)
        self.create_service(Trigger, "~/stop", self._stop)
        self._auto: Timer | None = self.create_timer(0.0, self._begin_itself, clock=_STEADY)

    # lifecycle

    def _begin_itself(self) -> None:
        """Configure and activate: it listens and makes its dry run, and moves nothing."""
        if self._auto is not None:
            self._auto.cancel()
            self._auto = None
            if self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
                self.trigger_activate()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to listen."""
        if not self._inputs:
            pose = self._chosen["measurement"] == "pose"
            kind, topic = (PoseStamped, "tracker/pose") if pose else (PointStamped, "tracker/point")
            heard: list[tuple[type, str, Callable[[Any], None], Any, bool]] = [
                (JointState, "joint_states", self._take_joints, FRESH, True),
                (kind, topic, self._take_reading, FRESH, True),
            ]
            if self._chosen["robot_description"]:
                self._describe(self._chosen["robot_description"])
            else:
                heard.append((String, "robot_description", self._take_description, LATCHED, True))
            self._inputs = [
                MonitoredSubscription(self, k, t, self._refusals.guarded(t, f), qos, needed=needed, single=True)
                for k, t, f, qos, needed in heard
            ]
        self._tell(OK, "waiting for the robot description and joint states")
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Check every period from here on."""
        self._active = True
        self._timer = self.create_timer(1.0 / self._chosen["rate_hz"], self._tick, clock=_STEADY)
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Hold the arm; a new dry run has to be accepted before it moves again."""
        self._rest("deactivated")
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget the dry run; what was measured is in the folder."""
        self._rest("cleaned up")
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Hold the arm."""
        self._rest("shut down")
        return super().on_shutdown(state)

    def close(self) -> None:
        """Hold the arm, and end."""
        self._rest("the node is shutting down")
        self._thinking.shutdown(wait=False, cancel_futures=True)

    def _rest(self, why: str) -> None:
        self._halt(why)
        self._active = self._shown = False
        self._summary = ""
        if self._timer is not None:
            self.destroy_timer(self._timer)
            self._timer = None

    # what it is asked

    def _show_dry_run(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """What the arm would do first; calling ~/start after this accepts it."""
        response.success = bool(self._summary)
        response.message = self._summary or f"there is no dry run yet: {self._said}"
        self._shown = self._shown or response.success
        return response

    def _start(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Begin, or go on after a hold."""
        try:
            self._begin()
            response.success, response.message = True, "measuring"
        except ModcalError as error:
            response.message = str(error)
        return response

    def _begin(self) -> None:
        if not self._active:
            raise BadCommand("start", "the node is not active", "configure and activate it first")
        if self._runner is None or not self._summary:
            raise BadCommand("start", f"there is no dry run yet: {self._said}", "wait for it, and look at ~/dry_run")
        if not (self._shown or self._chosen["yes"]):
            raise BadCommand("start", "nobody has looked at the dry run", "call ~/dry_run first, or set yes")
        if self._running:
            raise BadCommand("start", "it is measuring already", "call ~/stop first")
        self._now_joints(require=True)
        self._runner.release()
        self._running, self._begun, self._blind = True, True, 0
        self._tell(OK, "measuring")

    def _stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Hold the arm where it is, at once."""
        moved = self._runner is not None and self._runner.busy
        self._begun = True  # also what was accepted in advance waits for ~/start from here on
        self._halt("stopped as asked")
        response.success, response.message = True, "held" if moved else "nothing moved"
        return response

    def _halt(self, why: str) -> None:
        """Hold whatever moves, and begin nothing more."""
        self._running = False
        if self._runner is not None and self._runner.busy:
            self._send_hold(self._runner.hold(self._position(), why, time.monotonic()))
            self._tell(WARN, f"held: {why}")

    # what it hears

    def _take_description(self, message: String) -> None:
        self._describe(message.data)

    def _describe(self, urdf: str) -> None:
        if self._place is not None or self._future is not None:
            if self._place is not None and urdf != self._place.robot.description:
                raise BadCommand("robot_description", "changes while it measures", "start the node again for another")
            return
        chosen = dict(self._chosen)
        self._tell(OK, "looking at what the arm can reach")
        self._think(lambda: Place(urdf, chosen), self._placed)

    def _placed(self, place: Place) -> None:
        self._place = place
        self._joints = JointInput(place.robot.names, place.lower, place.upper)
        self._runner = Runner(place.lower, place.upper, self._rules())
        done = len(place.session.rows())
        self._tell(
            OK, f"{done} stations measured before; waiting for joint states" if done else "waiting for joint states"
        )

    def _take_joints(self, message: JointState) -> None:
        if self._joints is not None:
            self._joints.receive(message, self._clock_now(), max(self._chosen["timeout_s"], 1.0))
            self._received = time.monotonic()

    def _take_reading(self, message: Any) -> None:
        if self._runner is None:
            return
        if isinstance(message, PointStamped):
            p = message.point
            reading = np.array([p.x, p.y, p.z])
        else:
            p, r = message.pose.position, message.pose.orientation
            reading = np.array([p.x, p.y, p.z, r.x, r.y, r.z, r.w])
        if not np.isfinite(reading).all():
            raise BadCommand("tracker reading", "is not finite", "send numbers, or nothing where nothing is seen")
        stamp = seconds(message.header.stamp) or self._clock_now()
        self._runner.take_reading(reading, stamp, time.monotonic())

    # what it does

    def _tick(self) -> None:
        """One look at everything; a fault holds the arm."""
        try:
            self._look()
        except Exception as error:
            if not self.context.ok():
                raise
            said = self.faults.note("tick", error)
            self._halt(said)
            self._running = False
            self._tell(ERROR, said)

    def _look(self) -> None:
        runner = self._runner
        if runner is not None:
            runner.rules = self._rules()
            answer = runner.tick(time.monotonic(), self._now_joints())
            if isinstance(answer, Hold) or runner.phase == HELD:
                if self._running:
                    self._running = False
                    self._send_hold(answer if isinstance(answer, Hold) else None)
                    self._tell(ERROR, f"held: {runner.why}; clear the cause, then call ~/start")
            elif isinstance(answer, Done):
                self._noted(answer)
        if self._future is not None:
            if self._future.done():
                future, self._future = self._future, None
                self._take(future)
            return
        if time.monotonic() < self._again:
            return
        try:
            self._next()
        except ModcalError as error:
            self._refused(error)

    def _take(self, future: Future[Any]) -> None:
        """What came of thinking; what is refused is said, and tried again a little later."""
        try:
            self._then(future.result())
        except ModcalError as error:
            self._refused(error)

    def _refused(self, error: ModcalError) -> None:
        self._again = time.monotonic() + _AGAIN
        self._halt(str(error))
        self._tell(ERROR, str(error))

    def _next(self) -> None:
        """What to think about, or where to go, now that nothing is being thought about."""
        place, runner = self._place, self._runner
        if place is None or runner is None or runner.busy:
            return
        here = self._now_joints()
        if here is None:
            return
        if self._advice is None or (not place.session.pending and self._advice.outcome is None):
            if self._advice is None or self._running:
                self._tell(OK, "fitting and choosing")
                self._think(place.advise, self._advised)
            return
        if self._advice.outcome is not None:
            return
        speed = self._chosen["speed_rad_s"]
        if not self._summary:
            self._think(lambda: place.dry_run(here.q, speed), self._dry)
            return
        if self._chosen["yes"] and self._active and not self._begun:
            self._begin()
        if self._running and runner.phase == IDLE:
            number = place.session.pending[0]
            self._think(lambda: place.way(number, here.q, speed), self._go)

    def _advised(self, advice: Advice) -> None:
        self._advice = advice
        if advice.outcome is not None:
            self._running = False
            self._tell(OK, advice.outcome.sentence)
            assert self._place is not None
            place = self._place
            self._think(lambda: place.finish(advice), lambda _: None)
        else:
            self._tell(OK, f"{advice.why}: {len(advice.session.pending)} stations")

    def _dry(self, summary: str) -> None:
        self._summary = summary
        self._tell(OK, f"dry run: {summary}")

    def _go(self, way: StationWay) -> None:
        """Begin the motion to a station, if it may still be begun."""
        place, runner = self._place, self._runner
        assert place is not None
        assert runner is not None
        station = place.session.stations[way.number]
        if way.motion is None:
            self._tell(WARN, f"station {way.number + 1} is skipped: no free way to it was found")
            place.note(way.number, replace(station, state=SKIPPED))
            return
        here = self._now_joints()
        if not self._running or runner.phase != IDLE or here is None:
            return
        if np.abs(here.q - way.motion.q[0]).max() > self._chosen["tolerance_rad"]:
            return  # somebody else moved the arm: another way is looked for
        sent = runner.begin(way.number, station, way.motion, time.monotonic())
        self._send(sent)
        self._tell(OK, f"going to station {way.number + 1} ({station.role})")

    def _noted(self, done: Done) -> None:
        assert self._place is not None
        self._place.note(done.number, done.station)
        self._blind = self._blind + 1 if done.station.state == UNSEEN else 0
        if done.station.state == UNSEEN:
            self._tell(WARN, f"station {done.number + 1} was not seen by the instrument: it is passed over")
        if self._blind >= _BLIND:
            self._running = False
            self._tell(
                ERROR, f"the instrument saw nothing at {_BLIND} stations in a row: look at it, then call ~/start"
            )

    def _send(self, sent: Send) -> None:
        self._publish(sent.motion)

    def _publish(self, motion: TimedMotion) -> None:
        assert self._place is not None
        message = JointTrajectory(joint_names=list(self._place.robot.names))  # without a stamp: from now on
        for after, q, v in zip(motion.t[1:], motion.q[1:], motion.v[1:], strict=True):
            point = JointTrajectoryPoint(positions=q.tolist(), velocities=v.tolist())
            set_seconds(point.time_from_start, float(after))
            message.points.append(point)
        self._trajectory.publish(message)

    def _send_hold(self, hold: Hold | None) -> None:
        """A trajectory of one point, where the arm is."""
        if hold is None or self._place is None:
            return
        still = np.zeros_like(hold.q)
        self._publish(TimedMotion(np.array([0.0, _STOPPING]), np.array([hold.q, hold.q]), np.array([still, still])))

    def _think(self, work: Callable[[], Any], then: Callable[[Any], None]) -> None:
        """Do something that takes long elsewhere, so that every period is kept; one at a time."""
        self._then = then
        self._future = self._thinking.submit(work)

    # what it knows

    def _rules(self) -> Rules:
        c = self._chosen
        return Rules(
            c["timeout_s"], c["tracking_rad"], c["tolerance_rad"], c["settle_s"], c["patience_s"], int(c["readings"])
        )

    def _position(self) -> Array | None:
        return None if self._joints is None or self._joints.missing() else self._joints.position.copy()

    def _now_joints(self, require: bool = False) -> JointReport | None:
        """What the joints report; None while some were never heard of. require: raises BadCommand for old ones."""
        if require:
            if self._joints is None:
                raise BadCommand("joint_states", "not received yet", "start the driver, or remap the topic")
            self._joints.require_fresh(self._clock_now(), max(self._chosen["timeout_s"], 1.0))
        q = self._position()
        if q is None or self._joints is None:
            return None
        effort = self._joints.effort.copy()
        # joints may come in messages of several drivers: the one heard longest ago counts
        now, age = time.monotonic(), max(self._clock_now() - float(self._joints.stamps.min()), 0.0)
        return JointReport(q, min(self._received, now - age), effort if np.isfinite(effort).all() else None)

    def _clock_now(self) -> float:
        return 1e-9 * self.get_clock().now().nanoseconds

    def _tell(self, level: bytes, said: str) -> None:
        if (level, said) != (self._level, self._said):
            log = self.get_logger()
            if level == OK:
                log.info(said)
            elif level == WARN:
                log.warning(said)
            else:
                log.error(said)
        self._level, self._said = level, said

    def _report(self) -> list[Status]:
        facts: dict[str, object] = {"phase": self._runner.phase if self._runner is not None else ""}
        if self._advice is not None:
            status = self._advice.status
            facts |= {
                "stations measured": len(self._place.session.rows()) if self._place is not None else 0,
                "expected mm": "" if status.expected is None else f"{1e3 * status.expected:.4f}",
                "proven mm": "" if status.bound is None else f"{1e3 * status.bound:.4f}",
                "stations needed": "" if status.needed is None else status.needed,
                "ending": "" if self._advice.outcome is None else self._advice.outcome.ending,
            }
        refused = self._refusals.recent()
        return [
            subscription_status(self._inputs),
            Status("measuring", self._level, self._said, facts),
            Status("inputs", WARN if refused else OK, refused or "nothing was refused"),
        ]


def main() -> None:
    """Entry point of the executable."""
    run(StationRunner)

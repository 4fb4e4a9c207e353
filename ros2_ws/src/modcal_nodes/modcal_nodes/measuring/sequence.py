"""From the robot's description to the last station: choose, show the dry run, go, note, and choose again.

Nothing moves before a dry run was accepted. What takes long is done in a thread;
each period looks at what came of it, and at the arm. Any refusal holds the arm.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from modcal_core.errors import BadCommand, BadRobot, BadTable, ModcalError
from modcal_core.files import read_yaml
from modcal_core.geometry import Array
from modcal_core.measurements import POINT, POSE
from modcal_core.outcome import counted
from modcal_core.planning import (
    SKIPPED,
    UNSEEN,
    Advice,
    Advisor,
    Goal,
    Method,
    Session,
    Site,
    TimedMotion,
    free_way,
    from_side,
    site_from_data,
    survey,
    timed,
    with_limits,
)
from modcal_core.robot import Robot
from modcal_core.robots import Mechanism, collision_shapes, forward, read_drives
from modcal_nodes.measuring.collision import CollisionModel
from modcal_nodes.measuring.folder import Measurement
from modcal_nodes.measuring.runner import (
    HELD,
    IDLE,
    Done,
    Hold,
    JointReports,
    Rules,
    Runner,
)
from modcal_nodes.ros import ERROR, OK, WARN

if TYPE_CHECKING:
    from sensor_msgs.msg import JointState

_SIDE = 0.05  # rad or m from which a station is come to where the side matters


class Place:
    """One robot at one site. chosen: the parameters of ``station_runner``. urdf: text of the description. clock: in
    seconds, by which joint states are stamped.
    """

    def __init__(self, urdf: str, chosen: Mapping[str, Any], clock: Callable[[], float] = time.time) -> None:
        """Raises ModcalError for what cannot be: another robot's session, a description without shapes, a bad site."""
        self.robot = Robot.from_urdf(urdf, chosen["base"] or None, chosen["tip"] or None)
        site_file = Path(chosen["site"]) if chosen["site"] else None
        self.site = Site() if site_file is None else site_from_data(read_yaml(site_file), str(site_file))
        limits = with_limits(self.robot.mechanism, self.site)
        ends = np.asarray(self.robot.mechanism.lower), np.asarray(self.robot.mechanism.upper)
        self.joints, self.runner = JointReports(self.robot.mechanism, ends, clock), Runner(*ends)
        self._narrow = np.asarray(limits.lower), np.asarray(limits.upper)
        self._fastest = read_drives(urdf, self.robot.chain).speed
        self._slack = float(chosen["tolerance_rad"])
        self.shapes: CollisionModel | None = None
        if collision_shapes(urdf):
            folder = Path(chosen["meshes"]) if chosen["meshes"] else None
            self.shapes = CollisionModel(urdf, self.robot.names, self.site, folder)
        elif not chosen["no_self_collision"]:
            raise BadRobot(
                "robot_description",
                "has no collision shapes, so that the arm could not be kept from itself",
                "give one that has, or set no_self_collision: spheres along the links are then all that is checked",
            )
        kind, seed, minutes = chosen["measurement"], chosen["seed"], chosen["minutes"]
        if kind not in (POINT, POSE):
            raise BadTable(f"measurement '{kind}'", "is not read", "set pose or point")
        if chosen["statistic"] not in ("rms", "p95"):
            raise BadTable(f"statistic '{chosen['statistic']}'", "is not known", "set rms or p95")
        if not chosen["out"]:
            raise BadTable("out", "names no folder", "set it: the session is kept there")
        accuracy, seconds = 1e-3 * chosen["goal_mm"] or None, 60.0 * minutes or None
        goal = Goal(accuracy, chosen["statistic"], chosen["stations"], seconds)
        robot, method = self.robot, Method(seed, effects=not chosen["geometry_only"])
        self.pool = survey(robot.mechanism, self.site, np.random.default_rng(seed), kind, drawn=True)
        advisor = Advisor(robot.mechanism, self.pool, goal, method, None, robot.inertias)
        session = Session(robot.names, kind, carried=self.site.carried)
        self.kept = Measurement(Path(chosen["out"]), robot, advisor, session, seed, time.time())

    @property
    def session(self) -> Session:
        """What has been measured so far."""
        return self.kept.session

    def free(self, q: Array) -> np.ndarray:
        """True for postures (N, n) that are within limits and touch nothing, (N,)."""
        inside = ((q >= self._narrow[0] - 1e-9) & (q <= self._narrow[1] + 1e-9)).all(axis=1)
        out = np.array(inside)
        if self.shapes is not None:
            out[inside] = self.shapes.free(q[inside])
        else:
            out[inside] = self.pool.at.free(q[inside])
        return out

    def way(self, number: int, start: Array, speed: float) -> TimedMotion | None:
        """How to go to a pending station from a posture (n,), no joint faster than the speed [rad/s, m/s], nor than the
        description allows; None if no way is free. Raises BadRobot where the arm cannot begin: that is no fault of
        the station.
        """
        station = self.session.stations[number]
        goal, begin = station.asked, self._inside(start)
        self.require_free(begin)
        via = free_way(begin, goal, self.free, self.pool.where)
        if via is not None and station.approach is not None:
            beside = from_side(goal, station.approach, _SIDE)
            before = free_way(begin, beside, self.free, self.pool.where)
            last = None if before is None else free_way(beside, goal, self.free, self.pool.where[:0])
            via = None if before is None or last is None else [*before, goal]
        return None if via is None else timed([start, *via[1:]], np.minimum(speed, self._fastest))

    def _inside(self, q: Array) -> Array:
        """The posture (n,), within limits where it is beyond them by no more than an arm stands beside a station."""
        inside = np.clip(q, *self._narrow)
        return inside if np.abs(inside - q).max() <= self._slack else q

    def require_free(self, q: Array) -> None:
        """Raises BadRobot where the arm cannot begin from a posture (n,)."""
        if self.free(q[None])[0]:
            return
        touching = [] if self.shapes is None else self.shapes.touches(q)
        said = (
            f"{touching[0].one} touches {touching[0].other}" if touching else "lies outside limits or touches something"
        )
        raise BadRobot("posture of the arm", said, "move it by hand to where it is free, or correct site and shapes")

    def dry_run(self, start: Array, speed: float) -> str:
        """What the arm would do first, in sentences; nothing is sent. Raises ModcalError where it could not begin."""
        self.require_free(self._inside(start))
        pending, motions, here = self.session.pending, list[TimedMotion](), start
        for number in pending:
            if (motion := self.way(number, here, speed)) is not None:
                motions.append(motion)
                here = motion.end
        where = forward(self.robot.mechanism, self.pool.where)[:, :3, 3]
        box = ", ".join(
            f"{axis} {a:.2f} to {b:.2f}" for axis, a, b in zip("xyz", where.min(axis=0), where.max(axis=0), strict=True)
        )
        checked = [
            "limits",
            "the shapes of the description" if self.shapes is not None else "spheres along the links only",
        ]
        checked += ["floor"] if self.site.floor is not None else []
        if obstacles := len(self.site.boxes) + len(self.site.obstacles):
            checked.append(f"{obstacles} obstacles")
        return (
            f"{len(pending)} stations first, {sum(motion.t[-1] for motion in motions):.0f} s of motion, "
            f"{len(pending) - len(motions)} of them without a free way (skipped). Joints move at {speed:g} rad/s at "
            f"most, less where the description says so. The tip may go anywhere in {box} m of {self.robot.base}. "
            f"Checked: {', '.join(checked)}. Nothing has moved: call ~/start to accept."
        )


_STOPPING = 0.2  # s that a controller is given to stop in
_AGAIN = 2.0  # s until what was refused is tried again
_BLIND = 20  # stations in a row that the instrument does not see, after which it is asked to be looked at


class StationSequence:
    """chosen: the parameters of ``station_runner``, as they are now. send: gives a motion to the controller. tell: says
    something, with its level. clock: seconds in which joint states are stamped. running: whether it goes from station
    to station. advice: what was chosen last, and how far the accuracy is proven.
    """

    def __init__(
        self,
        chosen: Mapping[str, Any],
        send: Callable[[TimedMotion], None],
        tell: Callable[[bytes, str], None],
        clock: Callable[[], float],
    ) -> None:
        self._chosen, self._send, self._tell, self._clock = chosen, send, tell, clock
        self._thinker = ThreadPoolExecutor(1, "thinking")
        self._thought: tuple[Future[Any], Callable[[Any], None]] | None = None  # what is done, and what gets the result
        self._place: Place | None = None
        self.advice: Advice | None = None
        self._summary, self._shown = "", False
        self._active = self.running = self._begun = False
        self._blind, self._again = 0, -np.inf

    # what it is asked

    def activate(self) -> None:
        """From here on the arm may be moved, once a dry run was accepted."""
        self._active = True

    def rest(self, why: str) -> None:
        """Hold the arm; a new dry run has to be accepted before it moves again."""
        self.halt(why)
        self._active = self._shown = False
        self._summary = ""

    def close(self) -> None:
        """Begin nothing more."""
        self._thinker.shutdown(wait=False, cancel_futures=True)

    def show(self, said: str) -> tuple[bool, str]:
        """(whether there is a dry run, what the arm would do first); start() after this accepts it."""
        self._shown = self._shown or bool(self._summary)
        return bool(self._summary), self._summary or f"there is no dry run yet: {said}"

    def start(self, said: str) -> None:
        """Begin, or go on after a hold. Raises ModcalError where it may not."""
        if not self._active:
            raise BadCommand("start", "the node is not active", "configure and activate it first")
        if self._place is None or not self._summary:
            raise BadCommand("start", f"there is no dry run yet: {said}", "wait for it, and look at ~/dry_run")
        if not (self._shown or self._chosen["yes"]):
            raise BadCommand("start", "nobody has looked at the dry run", "call ~/dry_run first, or set yes")
        if self.running:
            raise BadCommand("start", "it is measuring already", "call ~/stop first")
        self._place.joints.require_fresh(self._stale)
        self._place.runner.release()
        self.running, self._begun, self._blind = True, True, 0
        self._tell(OK, "measuring")

    def stop(self) -> bool:
        """Hold the arm where it is, at once; returns whether anything moved."""
        moved = self._place is not None and self._place.runner.busy
        self._begun = True  # also what was accepted in advance waits for start() from here on
        self.halt("stopped as asked")
        return moved

    def halt(self, why: str) -> None:
        """Hold whatever moves, and begin nothing more."""
        self.running = False
        if self._place is not None and self._place.runner.busy:
            self._send_hold(self._place.runner.hold(self._place.joints.position, why, time.monotonic()))
            self._tell(WARN, f"held: {why}")

    # what it hears

    def describe(self, urdf: str) -> None:
        """The robot's description. Raises BadCommand for another one while it measures."""
        if self._place is not None or self._thought is not None:
            if self._place is not None and urdf != self._place.robot.description:
                raise BadCommand("robot_description", "changes while it measures", "start the node again for another")
            return
        chosen = dict(self._chosen)
        self._tell(OK, "looking at what the arm can reach")
        self._think(lambda: Place(urdf, chosen, self._clock), self._placed)

    def _placed(self, place: Place) -> None:
        self._place = place
        done = len(place.session.rows())
        before = f"{counted(done, 'station')} measured before; " if done else ""
        self._tell(OK, f"{before}waiting for joint states")

    def take_joints(self, message: JointState) -> None:
        """A joint state."""
        if self._place is not None:
            self._place.joints.receive(message, self._stale)

    def take_reading(self, reading: Array, stamp: float) -> None:
        """A reading of the instrument (3,) or (7,), and its stamp [s]. Raises BadCommand for one that is not finite."""
        if self._place is None:
            return
        if not np.isfinite(reading).all():
            raise BadCommand("tracker reading", "is not finite", "send numbers, or nothing where nothing is seen")
        self._place.runner.take_reading(reading, stamp, time.monotonic())

    # what it does

    def look(self) -> None:
        """One look at everything, every period."""
        if self._place is not None:
            self._look_at_arm(self._place)
        try:
            if self._thought is not None:
                self._take_thought(*self._thought)
            elif self._place is not None and time.monotonic() >= self._again:
                self._next(self._place)
        except ModcalError as error:  # it is said, and tried again a little later
            self._again = time.monotonic() + _AGAIN
            self.halt(str(error))
            self._tell(ERROR, str(error))

    def _think(self, work: Callable[[], Any], then: Callable[[Any], None]) -> None:
        """Do this elsewhere, one thing at a time; ``then`` gets what comes of it, at a later look."""
        self._thought = self._thinker.submit(work), then

    def _take_thought(self, future: Future[Any], then: Callable[[Any], None]) -> None:
        if future.done():
            self._thought = None
            then(future.result())

    def _look_at_arm(self, place: Place) -> None:
        runner, c = place.runner, self._chosen
        runner.rules = Rules(
            c["timeout_s"], c["tracking_rad"], c["tolerance_rad"], c["settle_s"], c["patience_s"], int(c["readings"])
        )
        answer = runner.tick(time.monotonic(), place.joints.now())
        if self.running and runner.phase == HELD:
            self.running = False
            self._send_hold(answer if isinstance(answer, Hold) else None)
            self._tell(ERROR, f"held: {runner.why}; clear the cause, then call ~/start")
        elif isinstance(answer, Done):
            self._noted(place, answer)

    def _next(self, place: Place) -> None:
        """What to think about, or where to go, now that nothing is being thought about."""
        here, advice = place.joints.now(), self.advice
        if place.runner.busy or here is None or (advice is not None and advice.outcome is not None):
            return
        speed = self._chosen["speed_rad_s"]
        if advice is None or not place.session.pending:
            if advice is None or self.running:
                self._tell(OK, "fitting and choosing")
                self._think(place.kept.advise, lambda found: self._advised(place, found))
        elif not self._summary:
            self._think(lambda: place.dry_run(here.q, speed), self._dry)
        else:
            if self._chosen["yes"] and self._active and not self._begun:
                self.start("")
            if self.running and place.runner.phase == IDLE:
                number = place.session.pending[0]
                way = partial(place.way, number, here.q, speed)
                self._think(way, lambda motion: self._go(place, number, motion))

    def _advised(self, place: Place, advice: Advice) -> None:
        self.advice = advice
        if advice.outcome is not None:
            self.running = False
            self._tell(OK, advice.outcome.sentence)
            self._think(lambda: place.kept.finish(advice), lambda _: None)
        else:
            self._tell(OK, f"{advice.why}: {counted(len(advice.session.pending), 'station')}")

    def _dry(self, summary: str) -> None:
        self._summary = summary
        self._tell(OK, f"dry run: {summary}")

    def _go(self, place: Place, number: int, motion: TimedMotion | None) -> None:
        station, here = place.session.stations[number], place.joints.now()
        if motion is None:
            self._tell(WARN, f"station {number + 1} is skipped: no free way to it was found")
            place.kept.note(number, replace(station, state=SKIPPED))
        elif self.running and place.runner.phase == IDLE and here is not None:
            if np.abs(here.q - motion.q[0]).max() > self._chosen["tolerance_rad"]:
                return  # somebody else moved the arm: another way is looked for
            place.runner.begin(number, station, motion, time.monotonic())
            self._send(motion)
            self._tell(OK, f"going to station {number + 1} ({station.role})")

    def _noted(self, place: Place, done: Done) -> None:
        place.kept.note(done.number, done.station)
        unseen = done.station.state == UNSEEN
        self._blind = self._blind + 1 if unseen else 0
        if unseen:
            self._tell(WARN, f"station {done.number + 1} was not seen by the instrument: it is passed over")
        if self._blind >= _BLIND:
            self.running = False
            said = f"the instrument saw nothing at {_BLIND} stations in a row: look at it, then call ~/start"
            self._tell(ERROR, said)

    def _send_hold(self, hold: Hold | None) -> None:
        """A trajectory of one point, where the arm is."""
        if hold is not None:
            still = np.zeros_like(hold.q)
            self._send(TimedMotion(np.array([0.0, _STOPPING]), np.array([hold.q, hold.q]), np.array([still, still])))

    # what it knows

    @property
    def chain(self) -> Mechanism | None:
        """The arm; None while it is not known."""
        return None if self._place is None else self._place.robot.mechanism

    @property
    def measured(self) -> int:
        """Stations so far."""
        return len(self._place.session.rows()) if self._place is not None else 0

    @property
    def facts(self) -> dict[str, object]:
        """Where the measurement stands, for the diagnostics."""
        facts: dict[str, object] = {"phase": "" if self._place is None else self._place.runner.phase}
        if self.advice is not None:
            status, ended = self.advice.status, self.advice.outcome
            facts |= {
                "stations measured": self.measured,
                "expected mm": "" if status.expected is None else f"{1e3 * status.expected:.4f}",
                "proven mm": "" if status.bound is None else f"{1e3 * status.bound:.4f}",
                "stations needed": "" if status.needed is None else status.needed,
                "ending": "" if ended is None else ended.ending,
            }
        return facts

    @property
    def _stale(self) -> float:
        return max(float(self._chosen["timeout_s"]), 1.0)

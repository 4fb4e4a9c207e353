"""``calibrator``: hears the cell, calibrates the arm, watches whether the result still holds, and says so."""

from __future__ import annotations

import concurrent.futures.process
import time
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.task import Future
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import String
from std_srvs.srv import Trigger

from modcal_core.errors import BadRobot, BadTable, ModcalError
from modcal_core.measurements.recording import POINT, POSE
from modcal_core.online.estimator import Wander
from modcal_core.online.stream import Stream
from modcal_core.online.supervisor import ASKED, BETTER, Policy, Supervisor
from modcal_core.online.suspicion import Suspicion
from modcal_core.resolve import Job
from modcal_core.robots.chain import Chain
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import read_inertias
from modcal_core.robots.urdf_write import calibrated_urdf
from modcal_msgs_py.messages import READING
from modcal_msgs_py.topics import TYPES
from modcal_nodes.calibrating.announcing import Announcer
from modcal_nodes.calibrating.memory import Memory
from modcal_nodes.calibrating.solving import Solved, Workshop, condense, solve
from modcal_nodes.calibrating.state import State, read_state, write_state
from modcal_nodes.calibrating.telling import Times, model_status, sample_status, tracker_status
from modcal_nodes.files import read_cell, write_folder
from modcal_nodes.health import Health, Status
from modcal_nodes.hearing import Ear, hearing_status
from modcal_nodes.parameters import CALIBRATOR, declare, values
from modcal_nodes.running import LATCHED, SENSOR, run

_POLL = 0.1  # s


class Calibrator(Node):
    """``~/solve`` calibrates, ``~/accept`` trusts the result, ``~/save`` keeps it on disk, ``~/reset`` forgets."""

    def __init__(self) -> None:
        super().__init__("calibrator")
        declare(self, CALIBRATOR)
        self._chosen = chosen = values(self, CALIBRATOR)
        if chosen["accept"] not in (ASKED, BETTER):
            raise BadTable(f"accept '{chosen['accept']}'", f"{BETTER} and {ASKED} are known", "set one of them")
        self._cell = read_cell(Path(chosen["cell"]) if chosen["cell"] else None, tuple(f for f in chosen["fixed"] if f))
        self._folder = Path(chosen["state"]) if chosen["state"] else None
        state = read_state(self._folder) if self._folder else State()
        self._memory = Memory(chosen["memory_s"])
        self._memory.samples = state.samples
        self._restored = state if state.calibration else None
        self._files = dict(state.files or {})
        self._candidate: Solved | None = None
        creeping = tuple(place for place in chosen["wandering"] if place)
        wander = Wander(creeping, chosen["wander_m"], chosen["wander_rad"]) if creeping else None
        policy = Policy(chosen["accept"], chosen["first_solve"], chosen["after_change"])
        self._supervisor = Supervisor(policy, wander)
        self._chain: Chain | None = None
        self._stream: Stream | None = None
        self._order: dict[tuple[str, ...], np.ndarray | None] = {}
        self._description = chosen["robot_description"]
        self._trouble = ""  # why the arm is not known, or the saved model not used
        self._verdict = "nothing solved yet"
        self._refused = 0
        self._said: Suspicion | None = None
        self._times = Times()

        self._announcer = Announcer(self)
        self._ears = self._listen(chosen["silent_s"])
        self._health = Health(self, self._statuses)
        self._workshop = Workshop()
        self._workshop.warm_up()
        self._work: tuple[concurrent.futures.Future[Any], Any] | None = None
        self._waiting: Future | None = None
        self._solve_next = False
        # a group of its own: while a solve is awaited, its group takes no other callback
        self.create_service(Trigger, "~/solve", self._on_solve, callback_group=ReentrantCallbackGroup())
        self.create_service(Trigger, "~/accept", self._on_accept)
        self.create_service(Trigger, "~/save", self._on_save)
        self.create_service(Trigger, "~/reset", self._on_reset)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_POLL, self._poll, clock=steady)
        self.create_timer(1.0, self._tell, clock=steady)
        self._know_arm()

    # hearing

    def _listen(self, patience: float) -> list[Ear]:
        hear = partial(Ear, self, patience=patience, single=True)
        readings = {"tracker/pose": (PoseStamped, POSE), "tracker/point": (PointStamped, POINT)}
        ears = [hear(JointState, "joint_states", self._joint_state, SENSOR, needed=True)]
        for topic, (message, kind) in readings.items():
            ears.append(hear(message, topic, partial(self._reading, topic, kind), SENSOR, single=False))
        ears.append(hear(Temperature, "temperature", self._temperature, SENSOR, single=False))
        description = hear(String, "robot_description", self._take_description, LATCHED, needed=not self._description)
        return [*ears, description]

    def _take_description(self, message: String) -> None:
        if self._chosen["robot_description"] or message.data == self._description:
            return
        if self._chain is not None:
            self._trouble = "robot_description has changed while running: restart this node to calibrate another robot"
            self.get_logger().error(self._trouble)
            return
        self._description = message.data
        self._know_arm()

    def _know_arm(self) -> None:
        """Read the arm off the description, as soon as it and the joints' names are there."""
        if self._chain is not None or not self._description:
            return
        names = self._memory.joint_names()
        if not names:
            return
        try:
            chain = read_chain(self._description, self._chosen["base"] or None, self._chosen["tip"] or None, names)
        except ModcalError as error:
            self._trouble = str(error)
            return
        if not set(chain.names) <= names:
            missing = ", ".join(n for n in chain.names if n not in names)
            self._trouble = f"joint_states does not name {missing} yet"
            return
        self._chain, self._trouble = chain, ""
        restored, self._restored = self._restored, None
        if restored is not None and restored.calibration is not None:
            try:
                restored.calibration.require_robot(chain)
            except BadRobot as error:
                # neither used nor overwritten
                self._trouble, self._folder = f"{self._folder}: {error}", None
                self._memory.samples = None
                self.get_logger().error(self._trouble)
            else:
                self._trust(self._files, restored)
        frames = self._supervisor.trusted.calibrated.frames if self._supervisor.trusted else ()
        self._stream = Stream(chain.names, frames)

    def _joint_state(self, message: JointState) -> None:
        began = time.perf_counter()
        names = tuple(message.name)
        if not self._remember("joint_states", message):
            return
        if self._stream is None:
            self._know_arm()
        if self._stream is not None and self._chain is not None:
            order = self._order.get(names)
            if order is None and names not in self._order:
                known = set(self._chain.names) <= set(names)
                order = np.array([names.index(n) for n in self._chain.names]) if known else None
                self._order[names] = order
            if order is not None:
                position = np.frombuffer(message.position)[order]
                effort = np.frombuffer(message.effort)[order] if len(message.effort) == len(names) else None
                self._feed(partial(self._stream.joint_state, _seconds(message.header.stamp), position, effort))
        self._times.took.append(time.perf_counter() - began)

    def _reading(self, topic: str, kind: str, message: Any) -> None:
        began = time.perf_counter()
        if not self._remember(topic, message) or self._stream is None:
            return
        stamp = _seconds(message.header.stamp)
        numbers = np.array(READING[kind](message))
        self._feed(partial(self._stream.reading, kind, message.header.frame_id, stamp, numbers))
        self._times.took.append(time.perf_counter() - began)
        self._times.late.append(1e-9 * self.get_clock().now().nanoseconds - stamp)

    def _temperature(self, message: Temperature) -> None:
        self._remember("temperature", message)

    def _remember(self, topic: str, message: Any) -> bool:
        received = 1e-9 * self.get_clock().now().nanoseconds
        try:
            self._memory.add(f"/{topic}", TYPES[topic], message, received)
        except ModcalError as error:
            self._refuse(error)
            return False
        return True

    def _feed(self, take: Any) -> None:
        assert self._stream is not None
        try:
            take()
        except ModcalError as error:
            self._refuse(error)
            return
        for sample in self._stream.take():
            self._supervisor.add(sample)

    def _refuse(self, error: ModcalError) -> None:
        self._refused += 1
        self.get_logger().warning(str(error), throttle_duration_sec=5.0)

    # solving

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._memory.clear()
        self._supervisor.forget()
        self._candidate = None
        self._announcer.no_change()
        response.success, response.message = True, "recording and candidate forgotten; the trusted model stays"
        return response

    async def _on_solve(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Solve beside the callbacks, which go on; answer when done."""
        refusal = self._begin_solve()
        if refusal:
            response.success, response.message = False, refusal
            return response
        self._waiting = Future(executor=self.executor)
        response.success, response.message = await self._waiting
        return response

    def _begin_solve(self) -> str:
        """Have a solve done in the workshop; returns why not, or nothing."""
        if self._solve_next or (self._work is not None and self._work[1] == self._solved):
            return "a solve is running already"
        self._know_arm()
        if self._chain is None:
            said = self._trouble or "publish it (latched), or set the parameter"
            return said if self._description and self._trouble else f"robot_description: not heard yet: {said}"
        if self._work is not None:  # something else is in the workshop, which takes a moment
            self._solve_next = True
            return ""
        job = Job(
            self._memory.heard(),
            self._chain,
            read_inertias(self._description, self._chain),
            self._cell,
            self._chosen["seed"],
            self._chosen["clock_limit_s"],
            self._supervisor.changed,
            self._supervisor.trusted,
        )
        self._work = self._workshop.give(solve, job, self._description), self._solved
        return ""

    def _poll(self) -> None:
        """Take what the workshop has finished, and give it what is due."""
        if self._work is not None:
            future, finish = self._work
            if not future.done():
                return
            self._work = None
            try:
                finish(future.result())
            except ModcalError as error:
                self._answer(False, str(error))
            except OSError as error:
                where = error.filename or "file system"
                self._answer(False, f"{where}: {error.strerror}: make room, or check its permissions")
            except Exception as error:  # a fault of ours must not leave the caller waiting
                self.get_logger().error(f"solve failed: {error!r}")
                self._answer(False, f"internal error: {error!r}")
                self._replace_broken_workshop(error)
        elif self._solve_next:
            self._solve_next = False
            if refusal := self._begin_solve():
                self._answer(False, refusal)
        elif self._chain is not None and self._memory.full:
            pieces = self._memory.pieces
            heard, limit = self._memory.finished(), self._chosen["clock_limit_s"]
            work = self._workshop.give(condense, heard, self._chain, limit, self._chosen["most_stations"])
            self._work = work, partial(self._condensed, pieces)
        elif self._supervisor.wants_solve() and (refusal := self._begin_solve()):
            self._verdict = refusal

    def _replace_broken_workshop(self, error: Exception) -> None:
        if isinstance(error, concurrent.futures.process.BrokenProcessPool):
            self._workshop = Workshop()

    def _condensed(self, pieces: int, samples: Any) -> None:
        self._memory.condensed(pieces, samples)
        self._save_samples()

    def _solved(self, solved: Solved) -> None:
        """Publish what a solve has found; trust it, if the policy says so."""
        if self._chosen["out"]:
            write_folder(Path(self._chosen["out"]), solved.files)
        self._announcer.result(solved.rms, solved.comparison)
        self._candidate = solved
        suspected = self._supervisor.suspicion
        if self._supervisor.solved(solved.calibration, solved.comparison.better):
            self._trusted(solved)
        self._verdict = solved.verdict
        if suspected is not None:
            found = "; ".join(sentence.rstrip(".") for sentence in solved.story) or "nothing that explains it"
            self._verdict = f"Since something changed: {found}. {solved.verdict}"
        self.get_logger().info(self._verdict)
        self._answer(True, self._verdict)

    def _answer(self, success: bool, message: str) -> None:
        if not success:
            self._verdict = message
            self._supervisor.failed()
        if self._waiting is not None:
            waiting, self._waiting = self._waiting, None
            waiting.set_result((success, message))
        self._health.publish()

    # trusting

    def _on_accept(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self._candidate is not None and self._supervisor.accept()
        response.message = "nothing to accept: the last result is trusted already, or there is none"
        if response.success and self._candidate is not None:
            self._trusted(self._candidate)
            response.message = "accepted"
        return response

    def _trusted(self, solved: Solved) -> None:
        """Publish and keep a result that is trusted from now on."""
        self._files, self._candidate = solved.files, None
        self._said = None
        if self._stream is not None:
            self._stream.frames = list(solved.calibration.calibrated.frames)
        self._announcer.model(solved.files)
        self._announcer.no_change()
        if self._folder:
            write_state(self._folder, State(solved.calibration, solved.files))

    def _trust(self, files: dict[str, str], state: State) -> None:
        """Go on with the model that was saved."""
        assert state.calibration is not None
        assert self._chain is not None
        if state.calibration.uncertainty is None:
            self._trouble = f"{self._folder}: written by an older version, without its uncertainty: solve again"
            return
        self._supervisor.trust(state.calibration)
        corrected = calibrated_urdf(self._description, self._chain, state.calibration.calibrated.chain)
        self._announcer.model({**files, "calibrated.urdf": corrected})
        self._verdict = "going on with the model that was saved"

    def _on_save(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = False, "no folder: set the parameter state"
        if self._folder:
            trusted = self._supervisor.trusted
            try:
                write_state(self._folder, State(trusted, self._files if trusted else None, self._memory.samples))
                response.success, response.message = True, f"saved in {self._folder}"
            except OSError as error:
                response.message = f"{self._folder}: {error.strerror}: make room, or check its permissions"
        return response

    def _save_samples(self) -> None:
        if self._folder and self._memory.samples is not None:
            try:
                write_state(self._folder, State(samples=self._memory.samples))
            except OSError as error:
                self.get_logger().error(f"{self._folder}: {error.strerror}: stations are not saved")

    def close(self) -> None:
        """Keep the stations heard so far, and end the workshop."""
        self._workshop.close()
        if self._folder and self._chain is not None:
            try:
                heard = self._memory.heard()
                if heard.recordings:
                    most, limit = self._chosen["most_stations"], self._chosen["clock_limit_s"]
                    self._memory.samples = condense(heard, self._chain, limit, most)
            except ModcalError as error:
                self.get_logger().warning(f"the last messages are not kept: {error}")
            self._save_samples()

    # telling

    def _tell(self) -> None:
        """Once a second: the running estimate, and what has changed."""
        live = self._supervisor.live
        if live is None:
            return
        self._announcer.estimate(live.estimator)
        if live.suspicion is not None and live.suspicion is not self._said:
            self._announcer.change(live.suspicion)
            if self._said is None or self._said.label != live.suspicion.label:
                self.get_logger().warning(f"{live.suspicion.sentence}; the last trusted model is still published")
            self._said = live.suspicion
            self._health.publish()

    def _statuses(self) -> Iterable[Status]:
        yield tracker_status(hearing_status(self._ears), self._ears)
        candidate = self._candidate.comparison if self._candidate else None
        yield model_status(self._supervisor, self._verdict, self._trouble, self._work is not None, candidate)
        counts = self._stream.counts if self._stream else None
        yield sample_status(self._supervisor.stations, self._refused, self._memory.jumps, counts, self._times)


def _seconds(stamp: Any) -> float:
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def main() -> None:
    """Entry point of the executable."""
    run(Calibrator)

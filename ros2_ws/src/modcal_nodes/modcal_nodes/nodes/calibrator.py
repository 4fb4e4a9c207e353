"""``calibrator``: hears the cell, calibrates the arm, watches whether the result still holds, and says so."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from std_msgs.msg import String

from modcal_core.calibration import to_data
from modcal_core.errors import BadRobot, ModcalError
from modcal_core.files import write_folder
from modcal_core.measurements import Dropped, Samples
from modcal_core.online import ChangeHypothesis, RandomWalk, Supervisor
from modcal_core.recalibrate import Job
from modcal_core.robots import calibrated_urdf, is_serial_arm, read_inertias
from modcal_nodes import calibrating, ros
from modcal_nodes.io import read_cell, read_delta

_POLL = 0.1  # s
_SOLVE, _CHECK = "solve", "check"
_STEP = 10  # stations between two lines in the log
_NOTHING = "nothing solved yet"


class Calibrator(ros.ManagedNode):
    """``~/solve`` calibrates, ``~/accept`` trusts the result, ``~/save`` keeps it on disk, ``~/reset`` forgets;
    ``~/check`` says by a few stations what has changed since. As a sentinel it watches the arm at its work.
    """

    executable = "calibrator"
    rest = 0.005  # s

    def _check(self, new: dict[str, Any]) -> None:
        calibrating.policy(new)

    def _serve(self) -> None:
        self._check_action = ros.Action(
            self, "Check", self._begin_check, self._cancel_check, self._check_progress, trigger=True
        )
        self._solve = ros.Action(self, "Solve", self._begin_solve, self._cancel_solve, self._progress, trigger=True)
        for name, act in (("accept", self._accept), ("save", self._save), ("reset", self._reset)):
            self.offer(f"~/{name}", act)

    def _configure(self) -> None:
        chosen = self._chosen
        self._cell = read_cell(Path(chosen["cell"]) if chosen["cell"] else None, tuple(f for f in chosen["fixed"] if f))
        self._folder = calibrating.StateFolder(chosen["state"], self.get_logger())
        self.held.callback(self._folder.release)
        state = self._folder.read()
        self._buffer = calibrating.Buffer(chosen["buffer_s"])
        self._buffer.samples = state.samples
        self._restored = state if state.calibration else None
        self._files = dict(state.files or {})
        self._watch: calibrating.SentinelWatch | None = None
        if chosen["sentinel"]:
            every, warn = chosen["sentinel_every_s"], self.get_logger().warning
            self._watch = calibrating.SentinelWatch(chosen["sentinel"], every, warn)
        self._candidate: calibrating.Solved | None = None
        creeping = tuple(place for place in chosen["process_noise_places"] if place)
        random_walk = RandomWalk(creeping, chosen["process_noise_m"], chosen["process_noise_rad"]) if creeping else None
        self._supervisor = Supervisor(calibrating.policy(chosen), random_walk)
        delta = read_delta(Path(chosen["delta"])) if chosen["delta"] else None
        self._arm = calibrating.KnownArm(chosen["robot_description"], chosen["base"], chosen["tip"], delta)
        self._trouble = ""  # why the saved model is not used
        self._verdict = _NOTHING
        self._standing: calibrating.Standing | None = None  # of the trusted model
        self._said: ChangeHypothesis | None = None

        self._outputs = calibrating.Publishers(self)
        self._tf = ros.Broadcaster(self, static=True) if chosen["publish_tf"] else None
        self._lacked, self._steps, self._framed = "", 0, 0
        corners = calibrating.CornerIntake.of(chosen)
        self._camera: calibrating.ByCamera | None = None
        if corners is not None:
            self._camera = calibrating.ByCamera(corners, chosen, self._outputs, self.get_logger(), self._camera_trusted)
        self._intake = calibrating.Intake(self, self._buffer, self._arm, self._supervisor, self._recognise, corners)
        described = bool(self._arm.description or self._arm.delta)
        patience = chosen["silence_timeout_s"]
        heard = () if corners is None else corners.topics
        self._inputs = calibrating.listen(self, self._intake, self._describe, patience, described, heard)
        self._commands = calibrating.CommandSubscription(self, self._intake.command)
        self.held.callback(self._keep)
        self._worker = calibrating.SolveWorker(self.get_logger().error)
        self.held.callback(self._worker.close)
        self._solve_next = False

    def _activate(self) -> None:
        self._outputs.hold()
        self.every(_POLL, self._poll)
        self.every(1.0, self._look)

    def _deactivate(self) -> None:
        """End what the worker does; the stations so far are kept."""
        if self._solve_next or self._worker.doing == _SOLVE:
            self._answer(False, "the node was deactivated")
        self._cancel_check("the node was deactivated")
        self._solve_next = False
        if self._worker.doing:
            self._worker.drop()

    def _take_parameters(self) -> None:
        self._supervisor.policy = calibrating.policy(self._chosen)
        for subscription in self._inputs:
            subscription.patience = self._chosen["silence_timeout_s"]

    def _describe(self, message: String) -> None:
        self._arm.describe(message.data)
        if self.active:
            self._recognise()

    def _recognise(self) -> None:
        """Go on with the model that was saved, once it is known that this is its arm."""
        if not self._arm.recognise(self._buffer.joint_names()) or self._arm.chain is None:
            return
        self._outputs.identify(self._arm.chain, self._observers)
        if self._camera is not None:
            self._camera.restore(self._arm, self._buffer, self._worker)
        restored, self._restored = self._restored, None
        if restored is None or restored.calibration is None:
            return
        try:
            restored.calibration.require_robot(self._arm.chain)
        except BadRobot as error:
            # neither used nor overwritten
            self._trouble, self._buffer.samples = f"{self._folder.path}: {error}", None
            self._folder.path = None
            self.get_logger().error(self._trouble)
            return
        if restored.calibration.uncertainty is None:
            self._trouble = f"{self._folder.path}: keeps no uncertainty: solve again"
            return
        self._supervisor.trust(restored.calibration)
        self._expect_frames()
        chain = self._arm.chain
        if is_serial_arm(chain):
            corrected = calibrated_urdf(self._arm.description, chain, restored.calibration.geometric.serial)
            self._files = {**self._files, "calibrated.urdf": corrected}
        self._outputs.model(self._files, to_data(restored.calibration))
        self._broadcast()
        self._verdict = "continuing with the saved model"
        self._standing = calibrating.standing_of(self._files.get("report.json"))

    def _observers(self) -> Sequence[str]:
        """Frames that are read; of images, the topics of their corners."""
        read = self._arm.stream.frames if self._arm.stream else ()
        return read or (self._camera.intake.topics if self._camera is not None else ())

    def _broadcast(self) -> None:
        if self._tf is not None and self._supervisor.trusted is not None:
            self._tf.publish(ros.static_frames(self._supervisor.trusted), self.get_clock().now().to_msg())

    def _lacks(self) -> str:
        """Why nothing can be solved or checked; empty: it can."""
        return calibrating.lacking(self._arm, self._inputs, self._camera is not None)

    def _expect_frames(self) -> None:
        if self._arm.stream is not None and self._supervisor.trusted is not None:
            self._arm.stream.frames = list(self._supervisor.trusted.calibrated.frames)

    def _reset(self) -> tuple[bool, str]:
        if self._solve_next or self._worker.doing == _SOLVE:
            self._cancel_solve("the data it was solved from have been cleared since")
        self._buffer.clear()
        self._supervisor.reset()
        self._candidate = None
        if self._camera is not None:
            self._camera.forget()
        self._outputs.no_change()
        return True, "recording and candidate cleared; the trusted model stays"

    def _cancel_solve(self, why: str = "cancelled") -> None:
        if self._worker.doing == _SOLVE:
            self._worker.drop()
        self._solve_next = False
        self._answer(False, why)

    def _progress(self, feedback: Any) -> None:
        feedback.phase = "waiting" if self._solve_next else "solving"
        feedback.elapsed_s = self._solve.elapsed

    def _begin_solve(self) -> str:
        if self._solve_next or self._worker.doing == _SOLVE:
            return "a solve is running already"
        self._recognise()
        if self._arm.chain is None or self._arm.trouble:
            return self._lacks()
        if self._worker.doing:  # something else is in the worker, which takes a moment
            self._solve_next = True
            return ""
        if self._camera is not None:
            return self._camera.begin(_SOLVE, self._arm, self._buffer, self._worker, self._answer_camera)
        job = Job(
            self._buffer.collected(),
            self._arm.chain,
            read_inertias(self._arm.description, chain) if is_serial_arm(chain := self._arm.chain) else None,
            self._cell,
            self._chosen["seed"],
            self._chosen["clock_limit_s"],
            self._supervisor.changed,
            self._supervisor.trusted,
            self._chosen["effects"],
        )
        done, fail = partial(self._solved, self._buffer.forgotten), partial(self._answer, False)
        page = bool(self._chosen["out"] or self._folder.path)  # without a folder nobody would ever see it
        self._worker.give(_SOLVE, calibrating.solve, job, self._arm.description, page, finish=done, fail=fail)
        return ""

    def _begin_check(self) -> str:
        """Have the worker say by the newest stations what has changed since; returns why it cannot, or nothing."""
        trusted, chain, chosen = self._supervisor.trusted, self._arm.chain, self._chosen
        if trusted is None:
            return "no model is trusted yet: solve and accept one, or set the parameter state"
        if chain is None or self._arm.trouble:
            return self._lacks()
        if self._worker.doing:
            return f"busy with {self._worker.doing}: ask again"
        heard, since = self._buffer.collected(), self._supervisor.changed
        work = heard, chain, trusted, chosen["clock_limit_s"], chosen["check_stations"], since
        fail = partial(self._check_action.end, ros.FAILED)
        self._worker.give(_CHECK, calibrating.live_check, *work, finish=self._checked, fail=fail)
        return ""

    def _cancel_check(self, why: str = "cancelled") -> None:
        if self._worker.doing == _CHECK:
            self._worker.drop()
            self._check_action.end(ros.FAILED, why)

    def _check_progress(self, feedback: Any) -> None:
        feedback.phase, feedback.elapsed_s = "checking", self._check_action.elapsed

    def _checked(self, data: dict[str, Any]) -> None:
        message, said = self._outputs.check(data), f"{data['verdict']} {data['advice']}"
        if data["status"] != "unchanged":  # a place that logs keeps its severity
            self.get_logger().warning(f"check: {said}")
        else:
            self.get_logger().info(f"check: {said}")
        self._check_action.end(ros.DONE, f"{said} {self._outputs.about()}", checked=message)

    def _answer_camera(self, success: bool, message: str) -> None:
        self._verdict = message
        self._answer(success, message)

    def _camera_trusted(self, files: dict[str, str]) -> None:
        self._files, self._standing = files, calibrating.standing_of(files.get("report.json"))

    def _poll(self) -> None:
        """Take what the worker has finished, and give it what is due."""
        if (commands := self._commands.look()) is not None:
            self._inputs.append(commands)
        if self._worker.poll():
            return
        if self._solve_next:
            self._solve_next = False
            if refusal := self._begin_solve():
                self._answer(False, refusal)
        elif self._arm.chain is None:
            self._buffer.keep(1)  # nobody can say what these are good for; they must not grow without end
        elif self._watch is not None and self._watch.begin(self._buffer, self._arm, self._worker):
            pass  # the worker has it
        elif pieces := self._buffer.pieces:
            most = self._chosen["max_stations"]
            work = self._buffer.finished(), self._arm.chain, self._chosen["clock_limit_s"], most
            now = self._buffer.forgotten
            done, fail = partial(self._condensed, pieces, now), partial(self._left_out, pieces, now)
            self._worker.give("condensing", calibrating.condense, *work, finish=done, fail=fail)
        elif self._supervisor.wants_solve() and (refusal := self._begin_solve()):
            self._verdict = refusal

    def _left_out(self, pieces: int, then: int, why: str) -> None:
        self.get_logger().warning(f"some minutes of messages are left out: {why}")
        if then == self._buffer.forgotten:
            self._buffer.left_out(pieces)

    def _condensed(self, pieces: int, then: int, made: tuple[Samples, Dropped]) -> None:
        if then == self._buffer.forgotten:  # else they are no longer wanted
            self._buffer.condensed(pieces, *made)
            self._folder.save_samples(self._buffer.samples)

    def _solved(self, then: int, solved: calibrating.Solved) -> None:
        if then != self._buffer.forgotten or self._arm.trouble:
            self._answer(False, self._arm.trouble or "the data it was solved from have been cleared since")
            return
        if self._chosen["out"]:
            write_folder(Path(self._chosen["out"]), solved.files)
        self._outputs.result(solved.rms, solved.comparison)
        self._candidate = solved
        suspected = self._supervisor.hypothesis
        if self._supervisor.solved(solved.calibration, solved.comparison.better):
            self._trusted(solved)
        self._verdict = solved.verdict
        if suspected is not None:
            found = "; ".join(sentence.rstrip(".") for sentence in solved.story) or "no explanation found"
            self._verdict = f"Since something changed: {found}. {solved.verdict}"
        self.get_logger().info(self._verdict)
        if self._chosen["out"]:
            self.get_logger().info(f"written to {self._chosen['out']}: {', '.join(sorted(solved.files))}")
        frames = solved.calibration.calibrated.frames
        told = " ".join((self._verdict, *solved.doubled, self._outputs.about(frames)))
        self._answer(True, told, verdict=self._outputs.verdict(solved.files["report.json"], frames))

    def _answer(self, success: bool, message: str, **found: Any) -> None:
        if not success:
            self._verdict = message
            self._supervisor.failed()
        self._solve.end(ros.DONE if success else ros.FAILED, message, **found)
        self._health.publish()

    def _accept(self) -> tuple[bool, str]:
        if self._arm.trouble:
            return False, self._arm.trouble
        if self._candidate is not None and self._supervisor.accept():
            self._trusted(self._candidate)
        elif self._camera is None or not self._camera.accept():
            return False, "nothing to accept: the last result is trusted already, or there is none"
        return True, f"accepted {self._outputs.about()}"

    def _trusted(self, solved: calibrating.Solved) -> None:
        self._files, self._candidate = solved.files, None
        self._standing = calibrating.standing_of(solved.files.get("report.json"))
        self._said = None
        self._expect_frames()
        self._outputs.model(solved.files, to_data(solved.calibration))
        self._broadcast()
        self._outputs.no_change()
        self._folder.write(solved.files)

    def _save(self) -> tuple[bool, str]:
        return self._folder.save(self._files if self._supervisor.trusted else {}, self._buffer.samples)

    def _keep(self) -> None:
        """Keep the stations and images heard so far."""
        if self._camera is not None:
            self._camera.keep()
        if self._folder.path and self._arm.chain is not None:
            try:
                heard = self._buffer.collected()
                if heard.recordings:
                    most, limit = self._chosen["max_stations"], self._chosen["clock_limit_s"]
                    self._buffer.samples, _ = calibrating.condense(heard, self._arm.chain, limit, most)
            except ModcalError as error:
                self.get_logger().warning(f"the last messages are not kept: {error}")
            self._folder.save_samples(self._buffer.samples)

    def _look(self) -> None:
        """Once a second: what is missing, how far collecting is, the running estimate, and what has changed."""
        if (lacks := self._lacks()) != self._lacked:
            self._lacked = lacks
            self.get_logger().warning(f"waiting: {lacks}") if lacks else self.get_logger().info(
                "all inputs are received"
            )
            self._health.publish()
        self._tell_frames()
        if self._supervisor.stations // _STEP != self._steps:
            self._steps = self._supervisor.stations // _STEP
            self.get_logger().info(calibrating.collected(self._supervisor))
        if self._camera is not None and self._camera.tell():
            self._health.publish()
        live = self._supervisor.live
        if live is None:
            return
        self._outputs.estimate(live.estimator)
        if live.hypothesis is not None and live.hypothesis is not self._said:
            self._outputs.change(live.hypothesis)
            if self._said is None or self._said.label != live.hypothesis.label:
                self.get_logger().warning(f"{live.hypothesis.sentence}; the last trusted model is still published")
            self._said = live.hypothesis
            self._health.publish()

    def _tell_frames(self) -> None:
        """Say that readings come in a frame that is new: it gets a place of its own."""
        frames = self._arm.stream.frames if self._arm.stream else []
        self._framed = min(self._framed, len(frames))
        for new in frames[self._framed :]:
            if self._framed:
                known = ", ".join(frames[: self._framed])
                self.get_logger().info(f"frame '{new}' is read beside {known}: an instrument or socket of its own")
            self._framed += 1

    def _report(self) -> Iterable[ros.Status]:
        heard = ros.subscription_status(self._inputs)
        if self._watch is not None:
            yield from self._watch.status()
            if self._standing is None and not any(s.count for s in self._inputs if "tracker/" in s.topic):
                yield heard
                return
        yield heard if self._camera is not None else ros.tracker_status(heard, self._inputs)
        if self._camera is not None:
            yield self._camera.intake.status()
        candidate = self._candidate.comparison if self._candidate else None
        trouble = self._trouble or self._arm.trouble
        solving = self._worker.doing == _SOLVE
        lacks = self._lacks() if self._standing is None and self._candidate is None else ""
        verdict = f"waiting: {lacks}" if lacks and self._verdict == _NOTHING else self._verdict
        yield calibrating.model_status(self._supervisor, verdict, self._standing, trouble, solving, candidate)
        if self._tf is not None:
            trouble = self._tf.trouble
            yield ros.Status(
                "tf", ros.ERROR if trouble else ros.OK, trouble or "frames of the trusted model are published"
            )
        yield calibrating.sample_status(self._supervisor, self._intake.refused, self._arm.stream, self._intake.times)

"""A calibration beside the node: in a process of its own, so that the callbacks keep up however long it takes."""

from __future__ import annotations

import json
import multiprocessing
import traceback
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from multiprocessing.connection import Connection
from threading import Thread
from typing import Any

import numpy as np
import rclpy
from rcl_interfaces.msg import Parameter
from std_msgs.msg import Bool, Float64, String

from modcal_core.calibration import Calibration
from modcal_core.camera import Moved
from modcal_core.errors import ModcalError, NotEnoughData
from modcal_core.files import parse_yaml
from modcal_core.measurements import Dropped, Samples
from modcal_core.online import ChangeHypothesis, Estimator
from modcal_core.outcome import one_instrument_notes
from modcal_core.public import check
from modcal_core.recalibrate import Job, ModelComparison, SampleMemory, recalibrate
from modcal_core.report import calibration_files, checkup_data, sentence
from modcal_core.robots import Mechanism
from modcal_msgs_py import fill_calibration, fill_change, fill_checked, fill_estimate, fill_identity, fill_verdict
from modcal_nodes.ros import LATCHED, GuardedNode, interface, settle_in

_YIELDING = 5  # of niceness: what nodes do within milliseconds goes before what takes seconds


@dataclass(frozen=True)
class Solved:
    """What a solve brings back: the calibration, the texts of its files, the comparison, and what was found.

    verdict: its sentence. rms: on stations that the fit has not seen [m]. doubled: sentences on frames that may be one
    instrument's.
    """

    calibration: Calibration
    files: dict[str, str]
    comparison: ModelComparison
    verdict: str
    story: tuple[str, ...]
    rms: float | None
    doubled: tuple[str, ...]


def solve(job: Job, urdf: str, page: bool = True) -> Solved:
    """Calibrate and write the texts, report.html only if page. Raises ModcalError for data that cannot carry a fit."""
    resolved = recalibrate(job)
    report = resolved.report
    size = report.size_mm("final")
    return Solved(
        resolved.result.calibration,
        calibration_files(resolved.result.calibration, report, job.chain, urdf, page=page),
        resolved.comparison,
        sentence(report),
        report.story,
        None if size is None else 1e-3 * size.rms,
        one_instrument_notes(resolved.result.scored),
    )


def condense(heard: SampleMemory, chain: Mechanism, clock_limit: float, most: int) -> tuple[Samples, Dropped]:
    """The samples of everything heard, at most so many, and what was left out. Raises ModcalError without any."""
    samples, _, lost = heard.prepared(chain, clock_limit, most)
    return samples, lost


@dataclass(frozen=True)
class _Work:
    name: str
    future: Future[Any]
    finish: Callable[[Any], None]
    fail: Callable[[str], None]


class WorkerEnded(Exception):
    """The process ended before its work was done."""


def _serve(calls: Connection) -> None:
    """Work on one call after the other, in the worker's process."""
    settle_in(_YIELDING)
    while True:
        work, arguments = calls.recv()
        try:
            calls.send((work(*arguments), None))
        except Exception as error:
            error.add_note(traceback.format_exc())
            calls.send((None, error))


def _exchange(calls: Connection, work: Callable[..., Any], arguments: tuple[Any, ...], future: Future[Any]) -> None:
    """Hand over a call and wait for what comes back, in a thread: neither fits into a pipe at once."""
    try:
        calls.send((work, arguments))
        result, error = calls.recv()
    except (EOFError, OSError):
        result, error = None, WorkerEnded("the solver process has ended")
    except Exception as unsent:
        result, error = None, unsent
    if error is None:
        future.set_result(result)
    else:
        future.set_exception(error)


class SolveWorker:
    """One process that works on one thing at a time. It ends with its parent, however that ends.

    A pool of the standard library hangs where its process is ended while it hands over a result.
    """

    def __init__(self, say: Callable[[str], object]) -> None:
        """say: where faults of our own are told."""
        self._say = say
        self._work: _Work | None = None
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._calls, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs,))
        self._process.start()
        theirs.close()  # so that its end is heard when it ends

    @property
    def doing(self) -> str:
        """The name of what is being worked on; empty: nothing."""
        return self._work.name if self._work else ""

    def give(
        self,
        name: str,
        work: Callable[..., Any],
        *arguments: Any,
        finish: Callable[[Any], None],
        fail: Callable[[str], None],
    ) -> None:
        """Have this done; arguments and result travel between processes. One of finish and fail is called by poll."""
        assert self._work is None
        if not self._process.is_alive():  # it was killed while it had nothing to do
            self._say(f"the solver process has ended; a new one is started for {name}")
            self._start()
        future = Future[Any]()
        Thread(target=_exchange, args=(self._calls, work, arguments, future), daemon=True).start()
        self._work = _Work(name, future, finish, fail)

    def poll(self) -> bool:
        """Take in what is finished; returns whether there was or is anything to do."""
        work = self._work
        if work is None:
            return False
        if work.future.done():
            self._work = None
            self._take_in(work)
        return True

    def _take_in(self, work: _Work) -> None:
        try:
            work.finish(work.future.result())
        except ModcalError as error:
            work.fail(str(error))
        except WorkerEnded as error:
            self._say(f"{work.name} failed: {error}")
            work.fail(f"internal error: {error}")
        except OSError as error:
            work.fail(f"{error.filename or 'file system'}: {error.strerror}: make room, or check its permissions")
        except Exception as error:  # a fault of ours must not leave the caller waiting
            if isinstance(error, RuntimeError) and not rclpy.ok():
                raise  # the node is told to stop, and nobody waits any more (see running.py)
            where = "\n".join(("", *getattr(error, "__notes__", ())))  # the other process's traceback
            self._say(f"{work.name} failed: {error!r}{where}")
            work.fail(f"internal error: {error!r}")

    def drop(self) -> None:
        """End what is being worked on without a result; neither finish nor fail is called."""
        self._work = None
        self.close()
        self._start()

    def close(self) -> None:
        """End what is being worked on."""
        self._process.kill()
        self._process.join()


class Publishers:
    """The calibrator's publishers. All are latched but the running estimate."""

    def __init__(self, node: GuardedNode) -> None:
        self._node = node
        self._chain: Mechanism | None = None
        self._observers: Callable[[], Sequence[str]] = tuple
        self._types = {name: interface(name) for name in ("Calibration", "Change", "Checked", "Estimate", "Verdict")}
        self._model, self._report, self._change, self._checked = (
            node.create_publisher(self._types[name], topic, LATCHED)
            for name, topic in (
                ("Calibration", "~/calibration"), ("Verdict", "~/report"), ("Change", "~/change"),
                ("Checked", "~/checked"),
            )
        )  # fmt: skip
        self._description = node.create_publisher(String, "~/robot_description", LATCHED)
        self._estimate = node.create_publisher(self._types["Estimate"], "~/estimate", 10)
        self._residual = node.create_publisher(Float64, "~/residual", LATCHED)
        self._before = node.create_publisher(Float64, "~/residual_before", LATCHED)
        self._trusted = node.create_publisher(Bool, "~/trusted", LATCHED)
        self._holds = False  # whether a model is trusted

    def identify(self, chain: Mechanism, observers: Callable[[], Sequence[str]]) -> None:
        """Speak of this arm from now on, as seen in the frames that observers gives at any time."""
        self._chain, self._observers = chain, observers

    def about(self, observers: Sequence[str] = ()) -> str:
        """What an answer is about, in words. observers: frames that led to it; empty: those that are read."""
        told = self._message("Verdict", observers).about
        return f"[robot {told.robot}, {told.base} to {told.tip}, seen by {', '.join(told.observers)}]"

    def hold(self, holds: bool | None = None) -> None:
        """Publish whether a model is trusted; None: as it was, so that who asks is not left waiting for one."""
        self._holds = self._holds if holds is None else holds
        self._trusted.publish(Bool(data=self._holds))

    def _message(self, name: str, observers: Sequence[str] = ()) -> Any:
        message = self._types[name]()
        if hasattr(message, "about"):
            fill_identity(message.about, self._chain, observers or self._observers())
        message.header.frame_id = "" if self._chain is None else self._chain.base
        message.header.stamp = self._node.get_clock().now().to_msg()
        return message

    def model(self, files: Mapping[str, str], calibration: Mapping[str, Any] | None = None) -> None:
        """Publish a model that is trusted from now on. calibration: data of calibration.yaml; None: it is read."""
        if "calibrated.urdf" in files:
            self._description.publish(String(data=files["calibrated.urdf"]))
        if calibration is None and (text := files.get("calibration.yaml")):
            calibration = parse_yaml(text, "calibration.yaml")
        if calibration is not None:
            self._model.publish(fill_calibration(self._message("Calibration"), Parameter, calibration))
        if "report.json" in files:
            self._report.publish(self.verdict(files["report.json"]))
        self.hold(True)

    def verdict(self, report: str, observers: Sequence[str] = ()) -> Any:
        """What the text of a report.json says of its model, as a Verdict. observers: frames that led to it."""
        return fill_verdict(self._message("Verdict", observers), json.loads(report))

    def result(self, rms: float | None, comparison: ModelComparison) -> None:
        """Publish how large the error is on stations that the fit has not seen, and was before [m]."""
        if rms is not None and np.isfinite(rms):
            self._residual.publish(Float64(data=float(rms)))
        if np.isfinite(comparison.before):
            self._before.publish(Float64(data=float(comparison.before)))

    def change(self, hypothesis: ChangeHypothesis) -> None:
        """Publish that something has changed, and what it may be; the model is not to be trusted blindly."""
        self._suspect(
            place=hypothesis.place,
            direction=hypothesis.direction,
            driver=hypothesis.driver,
            since_s=hypothesis.since,
            size_mm=1e3 * hypothesis.size,
            same_as=hypothesis.same_as,
            sentence=hypothesis.sentence,
        )

    def check(self, found: Mapping[str, Any]) -> Any:
        """Publish what a check has found, the data of check.json; returns the message."""
        message = fill_checked(self._message("Checked"), lambda: self._message("Change"), found)
        self._checked.publish(message)
        return message

    def moved(self, moved: Moved) -> None:
        """Publish that images show something to have been moved."""
        self._suspect(
            place=moved.what,
            direction="all",
            driver="time",
            since_s=moved.since,
            size_mm=1e3 * moved.shift_m,
            size_deg=float(np.degrees(moved.turn_rad)),
            sentence=moved.sentence,
        )

    def _suspect(self, **change: Any) -> None:
        self._change.publish(fill_change(self._message("Change"), change))
        self.hold(False)

    def no_change(self) -> None:
        """Publish that nothing is suspected any more."""
        self._change.publish(self._message("Change"))

    def estimate(self, estimator: Estimator) -> None:
        """Publish the values as they stand, and their standard deviations."""
        if np.isfinite(estimator.values).all() and np.isfinite(estimator.std).all():
            message = self._message("Estimate")
            self._estimate.publish(fill_estimate(message, estimator.names, estimator.values, estimator.std))


def live_check(
    heard: SampleMemory,
    chain: Mechanism,
    calibration: Calibration,
    clock_limit: float,
    newest: int,
    since: float | None,
) -> dict[str, Any]:
    """The check by so many newest stations, the data of check.json; by those since a stamp [s] where something is
    suspected to have changed. Raises ModcalError for too few, or for what is not of this arm.
    """
    samples, _, _ = heard.prepared(chain, clock_limit)
    kept = np.unique(samples.station[samples.stamps >= (-np.inf if since is None else since)])[-newest:]
    if len(kept) < newest:
        where = "" if since is None else " since something seems to have changed"
        said = f"a check looks at {newest}"
        raise NotEnoughData(f"{len(kept)} stations{where}", said, "drive to more, or set check_stations")
    return checkup_data(check(calibration, samples.select(np.flatnonzero(np.isin(samples.station, kept)))))

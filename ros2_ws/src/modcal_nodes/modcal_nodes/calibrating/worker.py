"""A calibration beside the node: in a process of its own, so that the callbacks keep up however long it takes."""

from __future__ import annotations

import multiprocessing
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from multiprocessing.connection import Connection
from threading import Thread
from typing import Any

import rclpy

from modcal_core.calibration import Calibration
from modcal_core.errors import ModcalError
from modcal_core.measurements import Dropped, Samples
from modcal_core.outcome import one_instrument_notes
from modcal_core.recalibrate import Job, ModelComparison, Recalibration, SampleMemory, recalibrate
from modcal_core.report import calibration_files, sentence
from modcal_core.robots import Mechanism
from modcal_nodes.calibrating.diagnostics import Standing, standing_of
from modcal_nodes.ros import settle_in

_YIELDING = 5  # of niceness: what nodes do within milliseconds goes before what takes seconds


@dataclass(frozen=True)
class Solved:
    """What a solve brings back: the calibration, the texts of its files, the comparison, and what was found.

    verdict: its sentence. standing: what may be said of the model. rms: on stations that the fit has not seen [m].
    doubled: sentences on frames that may be one instrument's.
    """

    calibration: Calibration
    files: dict[str, str]
    comparison: ModelComparison
    verdict: str
    standing: Standing
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
        _files(resolved, job, urdf, page),
        resolved.comparison,
        sentence(report),
        standing_of(report),
        report.story,
        None if size is None else 1e-3 * size.rms,
        one_instrument_notes(resolved.result.scored),
    )


def _files(resolved: Recalibration, job: Job, urdf: str, page: bool) -> dict[str, str]:
    calibration = resolved.result.calibration
    return calibration_files(calibration, resolved.report, job.chain, urdf, page=page)


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

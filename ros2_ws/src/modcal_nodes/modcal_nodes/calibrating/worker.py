"""A calibration beside the node: in a process of its own, so that the callbacks keep up however long it takes."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
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


class SolveWorker:
    """One process that works on one thing at a time. It ends with its parent, however that ends."""

    def __init__(self, say: Callable[[str], object]) -> None:
        """say: where faults of our own are told."""
        self._say = say
        self._work: _Work | None = None
        self._start()

    def _start(self) -> None:
        self._pool = ProcessPoolExecutor(
            1, multiprocessing.get_context("spawn"), initializer=settle_in, initargs=(_YIELDING,)
        )
        self._pool.submit(os.getpid)  # the first piece of work does not wait for the process to start

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
        try:
            future = self._pool.submit(work, *arguments)
        except BrokenProcessPool:  # it was killed while it had nothing to do
            self._say(f"the solver process has ended; a new one is started for {name}")
            self._start()
            future = self._pool.submit(work, *arguments)
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
        except OSError as error:
            work.fail(f"{error.filename or 'file system'}: {error.strerror}: make room, or check its permissions")
        except Exception as error:  # a fault of ours must not leave the caller waiting
            if isinstance(error, RuntimeError) and not rclpy.ok():
                raise  # the node is told to stop, and nobody waits any more (see running.py)
            where = f"\n{error.__cause__}" if error.__cause__ is not None else ""  # the other process's traceback
            self._say(f"{work.name} failed: {error!r}{where}")
            work.fail(f"internal error: {error!r}")
            if isinstance(error, BrokenProcessPool):
                self._start()

    def drop(self) -> None:
        """End what is being worked on without a result; neither finish nor fail is called."""
        self._work = None
        self.close()
        self._start()

    def close(self) -> None:
        """Drop what is waiting, and end what is being worked on."""
        for process in list((self._pool._processes or {}).values()):
            process.terminate()
        self._pool.shutdown(wait=True, cancel_futures=True)

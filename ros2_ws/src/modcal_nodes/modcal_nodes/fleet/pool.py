"""Tasks on the cores of this machine, one process a core, each task in one process at a time.

A process that is killed (out of memory, by hand) takes its task with it and nothing else: the task is tried once more
in a fresh process, and then said to have failed. ``concurrent.futures`` gives up all its work in that case.
"""

from __future__ import annotations

import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait

from modcal_nodes.fleet.task import FAILED, Outcome, Task
from modcal_nodes.one_thread import VARIABLES
from modcal_nodes.ros.child_process import settle_in

_TRIES = 2
_SPAWN = multiprocessing.get_context("spawn")


def run_here(tasks: Sequence[Task], jobs: int, work: Callable[[Task], Outcome]) -> Generator[Outcome, None, None]:
    """What becomes of each task, as it is finished, on so many processes. Closing the iterator ends them all.

    work: does a task; a function that other processes can import.
    """
    waiting = deque((task, 1) for task in tasks)
    workers: list[_Worker] = []
    try:
        while waiting or any(w.busy for w in workers):
            while waiting and len(workers) < jobs and not any(not w.busy for w in workers):
                workers.append(_Worker(work))
            for worker in workers:
                if waiting and not worker.busy:
                    worker.give(*waiting.popleft())
            for ready in wait([w.connection for w in workers if w.busy]):
                worker = next(w for w in workers if w.connection is ready)
                task, tries = worker.task, worker.tries
                outcome = worker.take()
                if outcome is None:
                    workers.remove(worker)
                    how = worker.end()
                    if tries < _TRIES:
                        waiting.appendleft((task, tries + 1))
                        continue
                    outcome = Outcome(task.name, FAILED, f"its process was ended {_TRIES} times, the last time {how}")
                yield outcome
    finally:
        for worker in workers:
            worker.end()


class _Worker:
    """A process that does what it is given."""

    task: Task
    tries: int

    def __init__(self, work: Callable[[Task], Outcome]) -> None:
        self.connection, theirs = _SPAWN.Pipe()
        self._process = _SPAWN.Process(target=_serve, args=(theirs, work), daemon=True)
        with _one_thread():
            self._process.start()
        theirs.close()  # so that the pipe ends when the process does
        self.busy = False

    def give(self, task: Task, tries: int) -> None:
        """Have it done, for the first or another time."""
        self.task, self.tries, self.busy = task, tries, True
        with suppress(BrokenPipeError, ConnectionResetError):  # it was killed while idle; taking says so
            self.connection.send(task)

    def take(self) -> Outcome | None:
        """What became of the task; None where the process has ended."""
        self.busy = False
        try:
            outcome: Outcome = self.connection.recv()
        except (EOFError, OSError):
            return None
        return outcome

    def end(self) -> str:
        """End the process; returns how it had ended by itself."""
        self._process.join(0.2)  # the pipe is closed a moment before the process is gone
        code = self._process.exitcode
        if code is None:
            self._process.kill()
        self._process.join()
        self.connection.close()
        self._process.close()
        return f"by signal {-code}" if code is not None and code < 0 else f"with code {code}"


def _serve(connection: Connection, work: Callable[[Task], Outcome]) -> None:
    settle_in()
    while True:
        try:
            task = connection.recv()
        except EOFError:
            return
        connection.send(work(task))


@contextmanager
def _one_thread() -> Iterator[None]:
    """What is started meanwhile has BLAS on one thread, also in a program that has not limited its own."""
    before = {name: os.environ.get(name) for name in VARIABLES}
    os.environ.update(dict.fromkeys(VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name)
            else:
                os.environ[name] = value

"""Tasks on a cluster that runs already: Dask distributed. Its workers read the bags; this process writes the results.

A worker that dies is the scheduler's to replace: it gives the task to another one, as often as its
``distributed.scheduler.allowed-failures`` says, and then the task is said to have failed.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence

from modcal_core.errors import BadCommand
from modcal_nodes.fleet.task import FAILED, Outcome, Task


def run_on_cluster(
    tasks: Sequence[Task], address: str, work: Callable[[Task], Outcome]
) -> Generator[Outcome, None, None]:
    """What becomes of each task, as it is finished. Raises BadCommand where no cluster answers.

    work: does a task; a function that the workers can import.
    """
    try:
        from distributed import Client, as_completed  # only who has a cluster has it installed
    except ImportError as error:
        raise BadCommand("--dask", "needs the package distributed", "pip install distributed") from error
    try:
        client = Client(address, timeout="10s", set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        said = f"no scheduler answers ({' '.join(str(error).split())})"
        raise BadCommand(f"--dask {address}", said, "give its address, host:port") from error
    with client:
        futures = {client.submit(work, task, pure=False, key=f"modcal-{task.name}"): task for task in tasks}
        try:
            for future in as_completed(list(futures), loop=client.loop):
                task, fault = futures[future], future.exception()
                yield future.result() if fault is None else Outcome(task.name, FAILED, _line(fault))
                future.release()  # its files need not stay on the cluster
        finally:
            client.cancel([future for future in futures if not future.done()])


def _line(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]

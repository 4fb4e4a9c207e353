"""Work for the processes of a pool that goes wrong in ways that no exception tells of."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from modcal_nodes.fleet.task import DONE, Outcome, Task


def quick(task: Task) -> Outcome:
    """Done at once; bags whose names say so take their process along, always or the first time."""
    if "always" in task.name or ("once" in task.name and first_time(task)):
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.05)
    return Outcome(task.name, DONE, row={"process": os.getpid(), "threads": os.environ.get("OMP_NUM_THREADS")})


def killed_once(task: Task) -> Outcome:
    """A calibration whose process is killed in the middle, the first time."""
    from modcal_nodes.fleet.work import do  # what is quick needs none of it

    done = do(task)
    if first_time(task):
        os.kill(os.getpid(), signal.SIGKILL)
    return done


def first_time(task: Task) -> bool:
    """Whether nobody has tried this before; the bag's folder remembers."""
    mark = Path(f"{task.bag}.tried")
    if mark.exists():
        return False
    mark.touch()
    return True

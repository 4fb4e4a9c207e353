"""How the time of many recordings falls with workers: `modcal fleet` over Dask on one and on two workers.

    make bench NAME=fleet_workers                          # ARGS="--recordings 20 --workers 1 2"

The recordings are copies of one of `bags/`: each is read, calibrated and written for itself. Scheduler and workers are
Dask's own commands, one thread each, as docs/fleet.md says; wall-clock time from the command to its end. Exit code 1
where a recording was not calibrated.
"""

from __future__ import annotations

import contextlib
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import harness

BAG = harness.ROOT / "bags" / "ur10_cell"


@contextlib.contextmanager
def cluster(workers: int, folder: Path) -> Iterator[str]:
    """The address of a scheduler with so many workers of one thread each; they end with the block."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    scheduler = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", address, "--no-dashboard"]
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-dashboard"]
    with contextlib.ExitStack() as stack, (folder / f"dask-{workers}.log").open("wb") as log:
        for words in [scheduler] + workers * [worker]:
            process = subprocess.Popen(words, cwd=folder, stdout=log, stderr=log)
            stack.callback(process.wait, 30.0)
            stack.callback(process.terminate)
        from distributed import Client

        with Client(address, timeout=60) as client:
            client.wait_for_workers(workers, timeout=60)
        yield address


def main() -> int:
    given, rows = harness.options(__doc__, seeds=0, recordings=100, workers=[1, 2]), []
    with harness.scratch() as folder:
        for k in range(given.recordings):
            shutil.copytree(BAG, folder / "recordings" / f"robot_{k}" / BAG.name)
        for workers in given.workers:
            with cluster(workers, folder) as address:
                words = ["fleet", folder / "recordings", "--out", folder / f"out-{workers}", "--dask", address]
                began = time.monotonic()
                modcal = Path(sys.executable).with_name("modcal")
                subprocess.run([modcal, *words], check=True, stdout=subprocess.DEVNULL)
                took = time.monotonic() - began
            first = rows[0][2] if rows else took
            rows.append([workers, given.recordings, took, took / given.recordings, first / took])
    harness.table("", ("workers", "recordings", "s", "s a recording", "times as fast as the first"), rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())

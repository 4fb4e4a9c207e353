"""How the time of many recordings falls with workers: `modcal fleet` over Dask on one and on two workers.

    make bench NAME=fleet_workers                  # ARGS="--recordings 20 --workers 1 2"

The recordings are copies of one of `bags/`: each is read, calibrated and written for itself. The cluster is Dask's own,
one thread a worker; wall-clock time from the command to its end. Exit code 1 where a recording was not calibrated.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from pathlib import Path

import harness
from distributed import LocalCluster

BAG = harness.ROOT / "bags" / "ur10_cell"


def main() -> int:
    given, rows = harness.options(__doc__, seeds=0, recordings=100, workers=[1, 2]), []
    with harness.scratch() as folder:
        for k in range(given.recordings):
            shutil.copytree(BAG, folder / "recordings" / f"robot_{k}" / BAG.name)
        for workers in given.workers:
            with LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster:
                words = ["fleet", folder / "recordings", "--out", folder / f"out-{workers}"]
                began = time.monotonic()
                modcal = Path(sys.executable).with_name("modcal")
                subprocess.run(
                    [modcal, *words, "--dask", cluster.scheduler_address], check=True, stdout=subprocess.DEVNULL
                )
                took = time.monotonic() - began
            first = rows[0][2] if rows else took
            rows.append([workers, given.recordings, took, took / given.recordings, first / took])
    harness.table("", ("workers", "recordings", "s", "s a recording", "times as fast as the first"), rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""How the time of many recordings falls with workers: `modcal fleet` over Dask, one and two workers on this machine.

    make fleet-workers             # BENCH_ARGS="--recordings 20 --workers 1 2"

The recordings are copies of one of `bags/`: each is read, calibrated and written for itself. Scheduler and workers are
Dask's own commands, one thread each, as docs/fleet.md says; wall-clock time from the command to its end. Ends with exit
code 1 where a recording was not calibrated.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BAG = ROOT / "bags" / "ur10_cell"
ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}


def free_port() -> int:
    """A port of this machine that nobody listens on."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


@contextlib.contextmanager
def cluster(workers: int, folder: Path) -> Iterator[str]:
    """The address of a scheduler with so many workers of one thread each; they end with the block."""
    address = f"tcp://127.0.0.1:{free_port()}"
    scheduler = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", address, "--no-dashboard"]
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-dashboard"]
    with contextlib.ExitStack() as stack, (folder / f"dask-{workers}.log").open("wb") as log:
        for words in [scheduler] + workers * [worker]:
            process = subprocess.Popen(words, cwd=folder, env=os.environ | ONE_THREAD, stdout=log, stderr=log)
            stack.callback(process.wait, 30.0)
            stack.callback(process.terminate)
        from distributed import Client

        with Client(address, timeout=60) as client:
            client.wait_for_workers(workers, timeout=60)
        yield address


def seconds(recordings: Path, out: Path, address: str) -> float:
    """Wall-clock time of one command."""
    modcal = str(Path(sys.executable).with_name("modcal"))
    began = time.monotonic()
    subprocess.run([modcal, "fleet", str(recordings), "--out", str(out), "--dask", address], check=True,
                   stdout=subprocess.DEVNULL, env=os.environ | ONE_THREAD)  # fmt: skip
    return time.monotonic() - began


def main() -> int:
    """Print the table; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--recordings", type=int, default=100)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for k in range(asked.recordings):
            shutil.copytree(BAG, folder / "recordings" / f"robot_{k}" / BAG.name)
        print("| workers | recordings | s | s a recording | times as fast as the first |\n" + 5 * "| --- " + "|")
        first = 0.0
        for workers in asked.workers:
            with cluster(workers, folder) as address:
                took = seconds(folder / "recordings", folder / f"out-{workers}", address)
            first = first or took
            each = took / asked.recordings
            print(f"| {workers} | {asked.recordings} | {took:.0f} | {each:.2f} | {first / took:.2f} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())

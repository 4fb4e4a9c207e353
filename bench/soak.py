"""Ten minutes of 1 kHz joint states and 200 Hz poses through recorder and calibrator, as real processes on two cores.

    make soak                      # SOAK_ARGS="--minutes 2" for a shorter one

Counts every recorded message against what the cell says it has published, asks the calibrator how long its updates
took and how old readings were by then, and watches the memory of all of them. Ends with exit code 1 when a limit is
broken.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import sys  # noqa: E402
import tempfile  # noqa: E402
import time  # noqa: E402
from collections.abc import Callable  # noqa: E402
from dataclasses import dataclass, field  # noqa: E402
from pathlib import Path  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import numpy as np  # noqa: E402
from nodes.cell import Said, call  # noqa: E402
from nodes.processes import Process, fresh_domain, listener, running  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402
from rosbags.rosbag2 import Reader  # noqa: E402
from scipy.stats import theilslopes  # noqa: E402

from modcal_core.geometry.so3 import Array  # noqa: E402

JOINT_RATE, TRACKER_RATE = 1000.0, 200.0  # Hz
WARM_UP = 0.4  # share of the time after which memory must be flat
TURN = 0.1  # share of the time after which the calibrator makes stations of what it heard
MAX_GROWTH = 2.0  # MB a minute after that, which is a hundred times less than what is heard
MAX_COMPUTE = 1.0  # ms of a processor, p99 of one update
SAMPLES, MODEL = "/calibrator: samples", "/calibrator: model"


@dataclass
class Usage:
    """Memory [MB] and CPU time [s] of a process and its children, with the time of day [s]."""

    pid: int
    at: list[float] = field(default_factory=list)
    memory: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)

    def look(self) -> None:
        """Note how things stand."""
        own, rss, cpu = [self.pid], 0.0, 0.0
        while own:
            pid = own.pop()
            try:
                status = Path(f"/proc/{pid}/statm").read_text().split()
                times = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
                own += [int(p) for p in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
            except (FileNotFoundError, ProcessLookupError):
                continue
            rss += int(status[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
            cpu += (int(times[11]) + int(times[12])) / os.sysconf("SC_CLK_TCK")
        self.at.append(time.monotonic())
        self.memory.append(rss)
        self.cpu.append(cpu)

    def turns(self, since: float, turn: float) -> Array:
        """Least and most [MB] in every whole turn [s] after a time, (k, 2).

        What is heard is kept for a turn and then condensed, so memory goes up and down with it.
        """
        t, m = np.array(self.at), np.array(self.memory)
        pieces = [m[(t >= b) & (t < b + turn)] for b in np.arange(since, t[-1] - 0.95 * turn, turn)]
        return np.array([(piece.min(), piece.max()) for piece in pieces])

    def growth(self, since: float, turn: float) -> float:
        """MB a minute by the median slope between the least of any two turns: what is never given back.

        A leak shows between all of them, while an allocator that takes a step once shows between few.
        """
        return float(60.0 / turn * theilslopes(self.turns(since, turn)[:, 0])[0])

    def share(self) -> float:
        """Cores used."""
        return (self.cpu[-1] - self.cpu[0]) / (self.at[-1] - self.at[0])


def main() -> int:
    """Run the soak; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    minutes = parser.parse_args().minutes
    with tempfile.TemporaryDirectory() as name:
        return _soak(Path(name), 60.0 * minutes)


def _soak(folder: Path, seconds: float) -> int:
    domain = fresh_domain()
    bag = folder / "bag"
    processes = {
        "recorder": Process("recorder", domain, folder, out=bag),
        "calibrator": Process("calibrator", domain, folder, buffer_s=TURN * seconds),
    }
    with running(*processes.values()), listener(domain) as (node, wait):
        said = Said(node)
        wait(lambda: said.level(SAMPLES) >= 0 and (bag.exists()), 60.0)
        urdf = ROOT / "examples" / "robots" / "ur10.urdf"
        cell = Process(
            "simulated_cell", domain, folder, urdf=urdf, seed=3, start_delay_s=5.0, stations=100, repeat=True,
            joint_rate_hz=JOINT_RATE, tracker_rate_hz=TRACKER_RATE,
        )  # fmt: skip
        with running(cell):
            processes["simulated_cell"] = cell
            usage = {key: Usage(process.popen.pid) for key, process in processes.items()}
            begin = time.monotonic()
            solved, ask = False, min(0.2 * seconds, 90.0)
            while time.monotonic() - begin < seconds:
                due = time.monotonic() + 5.0
                wait(lambda: time.monotonic() > due, 10.0)  # noqa: B023
                for one in usage.values():
                    one.look()
                if not solved and time.monotonic() - begin > ask:
                    answer = call(node, wait, "calibrator/solve")
                    solved, ask = answer.success, ask + 15.0
                    print(f"after {time.monotonic() - begin:.0f} s: {answer.message}", flush=True)
            figures = {v.key: v.value for part in (SAMPLES, MODEL) for v in said.last[part].values}
            assert cell.stop() == 0
        wait(lambda: time.monotonic() > due + 3.0, 10.0)
        assert processes["recorder"].stop(patience=60.0) == 0
        assert processes["calibrator"].stop(patience=120.0) == 0
    return _report(bag, usage, begin + WARM_UP * seconds, TURN * seconds, figures, _published(cell.output))


def _published(output: str) -> dict[str, int]:
    """What the cell says it has published when it ends, by topic."""
    lines = [line.partition("published ")[2] for line in output.splitlines() if "published " in line]
    parts = [part.split() for part in lines[-1].split(", ")] if lines else []
    return {topic: int(count) for count, topic in parts}


def _report(
    bag: Path, usage: dict[str, Usage], since: float, turn: float, figures: dict[str, str], published: dict[str, int]
) -> int:
    with Reader(bag) as reader:
        recorded = {topic: reader.topics[topic].msgcount for topic in published}
    lost = {topic: published[topic] - recorded[topic] for topic in published}
    p99 = float(figures["compute of an update, p99 [ms]"])
    table = Table("", "measured", "limit", "")
    broken = 0

    def row(what: str, value: str, limit: str, good: Callable[[], bool]) -> None:
        nonlocal broken
        broken += not good()
        table.add_row(what, value, limit, "ok" if good() else "[red]broken")

    for topic in sorted(published):
        row(f"{topic}: recorded of published", f"{recorded[topic]} of {published[topic]}", "all",
            lambda t=topic: lost[t] == 0 and published[t] > 0)  # type: ignore[misc]  # fmt: skip
    row("calibrator: compute of an update, p99", f"{p99:.3f} ms", f"{MAX_COMPUTE:g} ms", lambda: p99 <= MAX_COMPUTE)
    row("calibrator: state of its model", figures["state"], "trusted", lambda: figures["state"] == "trusted")
    for key in ("median", "p99"):
        table.add_row(f"from stamp to update, {key}", f"{figures[f'from stamp to update, {key} [ms]']} ms", "", "")
    for name, one in usage.items():
        growth, turns = one.growth(since, turn), " ".join(f"{a:.0f}–{b:.0f}" for a, b in one.turns(since, turn))
        table.add_row(f"{name}: memory, least and most of every turn", f"{turns} MB", "", "")
        row(f"{name}: memory, growth", f"{growth:+.2f} MB/min", f"{MAX_GROWTH:g} MB/min",
            lambda g=growth: g <= MAX_GROWTH)  # type: ignore[misc]  # fmt: skip
        table.add_row(f"{name}: cores", f"{one.share():.2f}", "", "")
    Console().print(table)
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())

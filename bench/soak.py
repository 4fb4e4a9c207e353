"""Ten minutes of 1 kHz joint states and 200 Hz poses through recorder and calibrator: losses, latency, memory.

    make bench NAME=soak                           # ARGS="--minutes 2" for a shorter one

Real processes on two cores. Counts every recorded message against what the cell says it has published, asks the
calibrator how long its updates took and how old readings were by then, and watches the memory of all of them. Exit code
1 when a limit is broken.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import harness

# isort: split
import numpy as np
from nodes.cell import Said, call
from nodes.processes import Process, fresh_domain, listener, running
from rosbags.rosbag2 import Reader
from scipy.stats import theilslopes

URDF = harness.ROOT / "examples" / "robots" / "ur10.urdf"
CELL = {"urdf": URDF, "seed": 3, "start_delay_s": 5.0, "stations": 100, "repeat": True}
CELL |= {"joint_rate_hz": 1000.0, "tracker_rate_hz": 200.0}
WARM_UP = 0.4  # share of the time after which memory must be flat
TURN = 0.1  # share of the time after which the calibrator makes stations of what it heard
LEAST_TURN = 20.0  # s, which the calibrator takes
MAX_GROWTH = 2.0  # MB a minute after that, which is a hundred times less than what is heard
MAX_COMPUTE = 1.0  # ms of a processor, p99 of one update
SAMPLES, MODEL = "/calibrator: samples", "/calibrator: model"


@dataclass
class Usage:
    """Times of day [s], memory [MB] and processor's time [s] of a process and its children."""

    pid: int
    looks: list[tuple[float, float, float]] = field(default_factory=list)

    def look(self) -> None:
        """Note how things stand."""
        own, rss, cpu = [self.pid], 0.0, 0.0
        while own:
            pid = own.pop()
            try:
                pages = Path(f"/proc/{pid}/statm").read_text().split()[1]
                times = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
                own += [int(p) for p in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
            except (FileNotFoundError, ProcessLookupError):
                continue
            rss += int(pages) * os.sysconf("SC_PAGE_SIZE") / 1e6
            cpu += (int(times[11]) + int(times[12])) / os.sysconf("SC_CLK_TCK")
        self.looks.append((time.monotonic(), rss, cpu))

    def turns(self, since: float, turn: float) -> np.ndarray:
        """Least and most [MB] in every whole turn [s] after a time, (k, 2): what is heard is kept for a turn and then
        condensed, so memory goes up and down with it.
        """
        t, m, _ = np.array(self.looks).T
        pieces = [m[(t >= b) & (t < b + turn)] for b in np.arange(since, t[-1] - 0.95 * turn, turn)]
        return np.array([(piece.min(), piece.max()) for piece in pieces])

    def growth(self, since: float, turn: float) -> float:
        """MB a minute by the median slope between the least of any two turns: what is never given back. A leak shows
        between all of them, while an allocator that takes a step once shows between few.
        """
        return float(60.0 / turn * theilslopes(self.turns(since, turn)[:, 0])[0])

    def share(self) -> float:
        """Cores used."""
        (first, _, before), (last, _, after) = self.looks[0], self.looks[-1]
        return (after - before) / (last - first)


def soak(folder: Path, seconds: float) -> int:
    """All of it; the exit code."""
    domain, bag, turn = fresh_domain(), folder / "bag", max(LEAST_TURN, TURN * seconds)
    processes = {
        "recorder": Process("recorder", domain, folder, out=bag),
        "calibrator": Process("calibrator", domain, folder, buffer_s=turn),
    }
    with running(*processes.values()), listener(domain) as (node, wait):
        said = Said(node)
        wait(lambda: said.level(SAMPLES) >= 0 and (bag.exists()), 60.0)
        cell = Process("simulated_cell", domain, folder, **CELL)
        with running(cell):
            processes["simulated_cell"] = cell
            usage = {key: Usage(process.popen.pid) for key, process in processes.items()}
            begin, solved, ask = time.monotonic(), False, min(0.2 * seconds, 90.0)
            while time.monotonic() - begin < seconds:
                due = time.monotonic() + 5.0
                wait(lambda: time.monotonic() > due, 10.0)  # noqa: B023
                for each in usage.values():
                    each.look()
                if not solved and time.monotonic() - begin > ask:
                    answer = call(node, wait, "calibrator/solve")
                    solved, ask = answer.success, ask + 15.0
                    harness.say(f"after {time.monotonic() - begin:.0f} s: {answer.message}")
            figures = {v.key: v.value for part in (SAMPLES, MODEL) for v in said.last[part].values}
            assert cell.stop() == 0
        wait(lambda: time.monotonic() > due + 3.0, 10.0)
        assert processes["recorder"].stop(patience=60.0) == 0
        assert processes["calibrator"].stop(patience=120.0) == 0
    published = {topic: int(count) for count, topic in re.findall(r"(\d+) (/\S+?)(?:,|$)", _last(cell.output))}
    return _report(bag, usage, begin + WARM_UP * seconds, turn, figures, published)


def _last(output: str) -> str:
    """What the cell says it has published when it ends."""
    return [line.partition("published ")[2] for line in output.splitlines() if "published " in line][-1]


def _report(
    bag: Path, usage: dict[str, Usage], since: float, turn: float, figures: dict[str, str], published: dict[str, int]
) -> int:
    with Reader(bag) as reader:
        recorded = {topic: reader.topics[topic].msgcount for topic in published}
    p99 = float(figures["compute of an update, p99 [ms]"])
    rows: list[tuple[str, str, str, bool]] = [
        (f"{topic}: recorded of published", f"{recorded[topic]} of {count}", "all", recorded[topic] == count > 0)
        for topic, count in sorted(published.items())
    ]
    rows += [
        ("calibrator: compute of an update, p99", f"{p99:.3f} ms", f"{MAX_COMPUTE:g} ms", p99 <= MAX_COMPUTE),
        ("calibrator: state of its model", figures["state"], "trusted", figures["state"] == "trusted"),
    ]
    for key in ("median", "p99"):
        rows.append((f"from stamp to update, {key}", f"{figures[f'from stamp to update, {key} [ms]']} ms", "", True))
    for name, of in usage.items():
        growth, turns = of.growth(since, turn), " ".join(f"{a:.0f}–{b:.0f}" for a, b in of.turns(since, turn))
        rows.append((f"{name}: memory, least and most of every turn", f"{turns} MB", "", True))
        limit = f"{MAX_GROWTH:g} MB/min"
        rows.append((f"{name}: memory, growth", f"{growth:+.2f} MB/min", limit, growth <= MAX_GROWTH))
        rows.append((f"{name}: cores", f"{of.share():.2f}", "", True))
    harness.table("", ("", "measured", "limit"), [row[:3] for row in rows])
    return harness.met(("every topic is recorded", bool(published)), *((row[0], row[3]) for row in rows))


def main() -> int:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--minutes", type=float, default=10.0)
    with harness.scratch() as folder:
        return soak(folder, 60.0 * made.parse_args().minutes)


if __name__ == "__main__":
    sys.exit(main())

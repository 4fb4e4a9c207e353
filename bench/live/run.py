"""What each node costs at 1 kHz of joint states and 200 Hz of poses, above a node that discards the same.

    make bench NAME=live                           # ARGS="--seconds 30 --only recorder"; chain: all of them at once

The simulated cell is the source. Each node runs beside two bare ones: one that ``rclpy.spin`` serves, one that takes
all that waits at once and rests between two looks. Times are of the processor, of the process and its children.

Then come the chains, each by itself: first all of modcal's nodes, then as many bare ones that are spun, then as many
that rest. Of each it is measured how old a pose is when it has been taken in, by the stamp that the cell should have
sent it with, and how many of the published messages were heard. Nobody listens to /diagnostics but once, when the cell
has ended.

Exit code 1 where a node costs more than five points of a core above the bare node that is spun, or where of the poses
of modcal's chain a hundredth is older than 50 ms, and older than that of the bare chain.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import harness

# isort: split
import conftest  # noqa: F401 (finds the install tree)
import numpy as np
from nodes.cell import Said
from nodes.processes import Process, environment, fresh_domain, listener, running
from soak import Usage

os.environ["ROS_PYTHON_CHECK_FIELDS"] = "0"  # as a user has it; the tests have it otherwise
BARE = Path(__file__).with_name("bare.py")
ABOVE = 5.0  # points of a core
LATE_MS = 50.0
BEGINNING, SETTLING, CHAIN = 6.0, 15.0, "chain"  # s before the source begins, and before it is measured
TOPICS, FIGURES = ("/joint_states", "/tracker/pose"), ("median", "p99")
ROOT = harness.ROOT
NODES: dict[str, dict[str, str]] = {  # with what each is started
    "recorder": {"out": "{folder}/bag"},
    "calibrator": {},
    "corrector": {"calibration": "{folder}/../calibration"},
    "acceleration_limits": {},
    "impedance_setpoint": {"autostart": "True"},
    "articulation_estimator": {},
}
CELL = {"urdf": f"{ROOT}/examples/robots/ur10.urdf", "seed": "3", "stations": "100", "repeat": "True"}
CELL |= {"joint_rate_hz": "1000.0", "tracker_rate_hz": "200.0"}


@contextlib.contextmanager
def node(name: str, domain: int, folder: Path, parameters: dict[str, str]) -> Iterator[Process]:
    """One of modcal's nodes, started as a user starts it, ended with the block."""
    given = {key: value.format(folder=folder) for key, value in parameters.items()}
    process = Process(name, domain, folder, from_nothing=True, **given)
    with running(process):
        yield process
        process.stop(signal.SIGINT)


@contextlib.contextmanager
def bare(way: str, domain: int, out: Path) -> Iterator[Any]:
    """A bare node; what it took, and how late, is in the file when the block has ended."""
    process = subprocess.Popen([sys.executable, str(BARE), way, str(out)], env=environment(domain))
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(60.0)


def shares(pids: dict[str, int], seconds: float) -> dict[str, float]:
    """Percent of a core that each uses, with its children, once all have settled."""
    usage = {name: Usage(pid) for name, pid in pids.items()}
    for wait in (SETTLING, seconds):
        time.sleep(wait)
        for each in usage.values():
            each.look()
    return {name: 100.0 * each.share() for name, each in usage.items()}


def cost(name: str, seconds: float, folder: Path) -> dict[str, float]:
    """Shares of a node, of the bare ones and of the source, in one run."""
    domain = fresh_domain()
    folder.mkdir()
    with contextlib.ExitStack() as stack:
        pids = {"node": stack.enter_context(node(name, domain, folder, NODES[name])).popen.pid}
        for way in ("spin", "rest"):
            pids[way] = stack.enter_context(bare(way, domain, folder / f"{way}.json")).pid
        time.sleep(BEGINNING)
        pids["source"] = stack.enter_context(node("simulated_cell", domain, folder, CELL)).popen.pid
        return shares(pids, seconds)


def chain(seconds: float, folder: Path, way: str = "") -> dict[str, Any]:
    """All nodes at once with the cell, or bare ones of a way: shares, how old poses were [ms], what was taken."""
    made: dict[str, Any] = {"late": {}, "taken": {}}
    domain, bares = fresh_domain(), [f"bare {k}" for k in range(1, len(NODES) + 1)] if way else []
    folder.mkdir()
    with contextlib.ExitStack() as stack:
        started = {} if way else {k: stack.enter_context(node(k, domain, folder, v)) for k, v in NODES.items()}
        pids = {name: process.popen.pid for name, process in started.items()}
        pids |= {name: stack.enter_context(bare(way, domain, folder / f"{name}.json")).pid for name in bares}
        time.sleep(BEGINNING)
        with node("simulated_cell", domain, folder, CELL) as cell:
            made["used"] = shares({**pids, "simulated_cell": cell.popen.pid}, seconds)
        if way:
            time.sleep(3.0)
        else:
            heard, wait = stack.enter_context(listener(domain))
            said, last = Said(heard), time.monotonic()
            parts = {"calibrator": "/calibrator: hearing", "recorder": "/recorder: topics"}
            needed = {"/calibrator: samples", *parts.values()}
            wait(lambda: time.monotonic() > last + 3.0 and needed <= set(said.last), 20.0)
            late = [said.value("/calibrator: samples", f"from stamp to update, {key} [ms]") for key in FIGURES]
            made["late"]["calibrator"] = [float(value) for value in late]
            for name, part in parts.items():
                made["taken"][name] = [int(said.value(part, f"messages of {topic}")) for topic in TOPICS]
    for name in bares:
        told = json.loads((folder / f"{name}.json").read_text())
        made["late"][name], made["taken"][name] = told["late_ms"], told["taken"]
    found = re.search(r"published (\d+) /joint_states, (\d+) /tracker/pose", cell.output)
    assert found is not None, cell.output
    return {**made, "published": [int(count) for count in found.groups()]}


def show(title: str, made: dict[str, Any]) -> None:
    """Print what a chain took, how late it was, and how much it heard."""
    used, late = made["used"], made["late"]
    shares = ", ".join(f"{k} {v:.1f}" for k, v in used.items())
    harness.say(f"\n{title}, % of a core: {shares}; together {sum(used.values()):.1f} of {100 * (os.cpu_count() or 1)}")
    harness.say(
        "stamp to taken, ms, median and p99: " + ", ".join(f"{k} {a:.2f} {b:.2f}" for k, (a, b) in late.items())
    )
    harness.say(f"joint states and poses published: {made['published']}; taken: {made['taken']}")


def main() -> int:
    made = harness.parser(__doc__, seeds=0, names=(*NODES, CHAIN))
    made.add_argument("--seconds", type=float, default=15.0)
    given, rows = harness.parsed(made), []
    targets: list[tuple[str, bool]] = []
    with harness.scratch() as folder:
        harness.succeeded("calibrate", ROOT / "bags" / "ur10_cell", "--out", folder / "calibration")
        for name in (name for name in given.names if name != CHAIN):
            used = cost(name, given.seconds, folder / name)
            above = used["node"] - used["spin"]
            rows.append(
                [name, *(f"{x:.1f}" for x in (used["node"], used["spin"], used["rest"], above, used["source"]))]
            )
            targets.append((f"{name}: {ABOVE:g} points above the bare node that is spun", above <= ABOVE))
        if rows:
            heads = ("node", "% of a core", "bare, spun", "bare, with rests", "above the spun one", "source")
            harness.table("", heads, rows)
        if CHAIN in given.names:
            long = 8.0 * given.seconds  # so that how the nodes begin is below a hundredth
            ours = chain(long, folder / CHAIN)
            show("modcal's nodes", ours)
            p99 = []
            for way, title in (("spin", "as many bare nodes, spun"), ("rest", "as many bare nodes, with rests")):
                bares = chain(long, folder / f"bare_{way}", way)
                show(title, bares)
                p99.append(float(np.median([late[1] for late in bares["late"].values()])))
            targets.append(("lateness of poses", ours["late"]["calibrator"][1] <= max(LATE_MS, p99[0])))
    return harness.met(*targets)


if __name__ == "__main__":
    sys.exit(main())

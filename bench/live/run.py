"""What each node costs at 1 kHz of joint states and 200 Hz of poses, above a node that takes and discards the same.

    make live                      # BENCH_ARGS="--seconds 30 --only recorder" for one of them, "--only chain" for all

Each node runs beside two bare ones: one that ``rclpy.spin`` serves, and one that takes all that waits at once and rests
between two looks. Times are of the processor, of the process and its children.

Then come the chains, each by itself, with the simulated cell as its source: first all of modcal's nodes, then as many
bare ones that are spun, then as many that rest. Of each it is measured how old a pose is when it has been taken in, by
the stamp that the cell should have sent it with, and how many of the published messages were heard. Nobody listens to
/diagnostics but once, when the cell has ended. ``--beside`` adds a bare node to modcal's nodes.

Ends with exit code 1 where a node costs more than five points of a core above the bare node that is spun, or where of
the poses of modcal's chain a hundredth is older than 50 ms, and older than that of the bare chain.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import contextlib  # noqa: E402
import json  # noqa: E402
import re  # noqa: E402
import signal  # noqa: E402
import subprocess  # noqa: E402
import sys  # noqa: E402
import tempfile  # noqa: E402
import time  # noqa: E402
from collections.abc import Iterator  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(ROOT / "tests"))

import conftest  # noqa: E402, F401 (finds the install tree)
from nodes.cell import Said  # noqa: E402
from nodes.processes import EXECUTABLES, environment, fresh_domain, listener  # noqa: E402

ABOVE = 5.0  # points of a core
LATE_MS = 50.0
BEGINNING, SETTLING = 6.0, 15.0  # s before the source begins, and before it is measured
TOPICS = ("/joint_states", "/tracker/pose")
FIGURES = ("median", "p99")
URDF = ROOT / "examples" / "robots" / "ur10.urdf"
NODES = (
    "recorder", "calibrator", "corrector", "acceleration_limits", "impedance_setpoint", "articulation_estimator",
)  # fmt: skip


def parameters(name: str, folder: Path) -> dict[str, Any]:
    """What a node is started with."""
    return {
        "recorder": {"out": folder / "bag"},
        "corrector": {"calibration": folder.parent / "calibration"},
        "impedance_setpoint": {"autostart": True},
    }.get(name, {})


@contextlib.contextmanager
def started(words: list[str], domain: int, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A process as a user starts it, ended at the end."""
    with (folder / f"{Path(words[-1]).name}-{time.monotonic_ns()}.log").open("wb") as log:
        process = subprocess.Popen(words, env=environment(domain) | {"ROS_PYTHON_CHECK_FIELDS": "0"}, stdout=log,
                                   stderr=subprocess.STDOUT, cwd=folder)  # fmt: skip
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(30.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def node(name: str, domain: int, folder: Path) -> contextlib.AbstractContextManager[subprocess.Popen[bytes]]:
    """One of modcal's nodes."""
    settings = [word for k, v in parameters(name, folder).items() for word in ("-p", f"{k}:={v}")]
    return started([str(EXECUTABLES / name), *(["--ros-args", *settings] if settings else [])], domain, folder)


def script(name: str, *words: str, domain: int, folder: Path) -> contextlib.AbstractContextManager[Any]:
    """One of the scripts beside this one."""
    return started([sys.executable, str(HERE / f"{name}.py"), *words], domain, folder)


@contextlib.contextmanager
def source(domain: int, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """The driver and the tracker, once they speak."""
    begun = folder / "begun"
    with script("source", str(URDF), str(begun), domain=domain, folder=folder) as process:
        while not begun.exists():
            assert process.poll() is None
            time.sleep(0.1)
        yield process


def cpu(pid: int) -> float:
    """Seconds of a processor that a process and its living children have used."""
    out, own = 0.0, [pid]
    while own:
        pid = own.pop()
        times = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        out += (int(times[11]) + int(times[12])) / os.sysconf("SC_CLK_TCK")
        own += [int(p) for p in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return out


def shares(processes: dict[str, subprocess.Popen[bytes]], settle: float, seconds: float) -> dict[str, float]:
    """Percent of a core that each uses."""
    time.sleep(settle)
    began, before = time.monotonic(), {key: cpu(p.pid) for key, p in processes.items()}
    time.sleep(seconds)
    after, took = {key: cpu(p.pid) for key, p in processes.items()}, time.monotonic() - began
    return {key: 100.0 * (after[key] - before[key]) / took for key in processes}


def cost(name: str, seconds: float, folder: Path) -> dict[str, float]:
    """Shares of a node, of the bare ones and of the source, in one run."""
    domain = fresh_domain()
    folder.mkdir()
    with contextlib.ExitStack() as stack:
        processes = {"node": stack.enter_context(node(name, domain, folder))}
        for way in ("spin", "rest"):
            words = (way, str(folder / f"{way}.json"))
            processes[way] = stack.enter_context(script("bare", *words, domain=domain, folder=folder))
        time.sleep(4.0)
        processes["source"] = stack.enter_context(source(domain, folder))
        return shares(processes, 8.0, seconds)


@contextlib.contextmanager
def cell(domain: int, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """The simulated cell, which works until it is ended."""
    settings = {"urdf": URDF, "seed": 3, "stations": 100, "repeat": True, "joint_rate_hz": 1000.0,
                "tracker_rate_hz": 200.0}  # fmt: skip
    words = [word for k, v in settings.items() for word in ("-p", f"{k}:={v}")]
    with started([str(EXECUTABLES / "simulated_cell"), "--ros-args", *words], domain, folder) as process:
        yield process


def published(folder: Path) -> list[int]:
    """Joint states and poses that the cell says it has published, when it has ended."""
    said = "".join(log.read_text() for log in folder.glob("*.log"))
    found = re.search(r"published (\d+) /joint_states, (\d+) /tracker/pose", said)
    assert found is not None, said
    return [int(count) for count in found.groups()]


def modcals_chain(seconds: float, folder: Path, beside: bool) -> dict[str, Any]:
    """All nodes at once with the cell: shares, and how old poses were for the calibrator [ms], median and p99."""
    domain = fresh_domain()
    folder.mkdir()
    with contextlib.ExitStack() as stack:
        processes = {name: stack.enter_context(node(name, domain, folder)) for name in NODES}
        if beside:
            words = ("spin", str(folder / "beside.json"))
            processes["bare, spun"] = stack.enter_context(script("bare", *words, domain=domain, folder=folder))
        time.sleep(BEGINNING)
        with cell(domain, folder) as processes["simulated_cell"]:
            used = shares(processes, SETTLING, seconds)
        heard, wait = stack.enter_context(listener(domain))
        said = Said(heard)
        last = time.monotonic()
        needed = {"/calibrator: samples", "/calibrator: hearing", "/recorder: topics"}
        wait(lambda: time.monotonic() > last + 3.0 and needed <= set(said.last), 20.0)
        late = [float(said.value("/calibrator: samples", f"from stamp to update, {key} [ms]")) for key in FIGURES]
        taken = [int(said.value("/calibrator: hearing", f"messages of {topic}")) for topic in TOPICS]
        recorded = [int(said.value("/recorder: topics", f"messages of {topic}")) for topic in TOPICS]
    made = {"used": used, "late": {"calibrator": late}, "taken": {"calibrator": taken, "recorder": recorded}}
    if beside:
        bare = json.loads((folder / "beside.json").read_text())
        made["late"]["bare, spun"] = bare["late_ms"]
    return made | {"published": published(folder)}


def bare_chain(seconds: float, folder: Path, way: str) -> dict[str, Any]:
    """The same of as many bare nodes in place of modcal's."""
    domain = fresh_domain()
    folder.mkdir()
    names = [f"bare {k}" for k in range(1, len(NODES) + 1)]
    with contextlib.ExitStack() as stack:
        processes = {}
        for name in names:
            words = (way, str(folder / f"{name}.json"))
            processes[name] = stack.enter_context(script("bare", *words, domain=domain, folder=folder))
        time.sleep(BEGINNING)
        with cell(domain, folder) as processes["simulated_cell"]:
            used = shares(processes, SETTLING, seconds)
        time.sleep(3.0)
    told = {name: json.loads((folder / f"{name}.json").read_text()) for name in names}
    late = {name: one["late_ms"] for name, one in told.items()}
    return {
        "used": used,
        "late": late,
        "taken": {name: one["taken"] for name, one in told.items()},
        "published": published(folder),
    }


def told(title: str, made: dict[str, Any]) -> None:
    """Print what a chain took, how late it was, and how much it heard."""
    used = made["used"]
    print(f"\n{title}, % of a core: " + ", ".join(f"{k} {v:.1f}" for k, v in used.items()), end="")
    print(f"; together {sum(used.values()):.1f} of {100 * (os.cpu_count() or 1)}")
    print("stamp to taken, ms, median and p99: ", end="")
    print(", ".join(f"{k} {v[0]:.2f} {v[1]:.2f}" for k, v in made["late"].items()))
    print(f"joint states and poses published: {made['published']}; taken: {made['taken']}", flush=True)


def chains(seconds: float, folder: Path, beside: bool) -> bool:
    """Print all chains; whether modcal's keeps to its limit, or to the bare one's."""
    ours = modcals_chain(seconds, folder / "chain", beside)
    told("modcal's nodes", ours)
    p99 = []
    for way, title in (("spin", "as many bare nodes, spun"), ("rest", "as many bare nodes, with rests")):
        made = bare_chain(seconds, folder / f"bare_{way}", way)
        told(title, made)
        p99.append(float(np.median([late[1] for late in made["late"].values()])))
    return bool(ours["late"]["calibrator"][1] <= max(LATE_MS, p99[0]))


def main() -> int:
    """Print the tables; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--only", default="", help="one node, or chain")
    parser.add_argument("--beside", action="store_true", help="a bare node beside modcal's, in the chain")
    asked = parser.parse_args()
    broken = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        modcal = Path(sys.executable).with_name("modcal")
        made = (str(modcal), "calibrate", str(ROOT / "bags" / "ur10_cell"), "--out", str(folder / "calibration"))
        subprocess.run(made, check=True, stdout=subprocess.DEVNULL)
        if asked.only != "chain":
            print("| node | % of a core | bare, spun | bare, with rests | above the spun one | source |")
            print(6 * "| --- " + "|")
        for each in NODES:
            if asked.only in ("", each):
                used = cost(each, asked.seconds, folder / each)
                above = used["node"] - used["spin"]
                broken += above > ABOVE
                row = [used["node"], used["spin"], used["rest"], above, used["source"]]
                print("| " + " | ".join([each, *(f"{x:.1f}" for x in row)]) + " |", flush=True)
        if asked.only in ("", "chain"):
            # eight times as long, so that how the nodes begin is below a hundredth
            broken += not chains(8.0 * asked.seconds, folder, asked.beside)
    return int(broken > 0)


if __name__ == "__main__":
    sys.exit(main())

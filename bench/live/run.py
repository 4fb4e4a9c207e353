"""What each node costs at 1 kHz of joint states and 200 Hz of poses, above a node that takes and discards the same.

    make live                      # BENCH_ARGS="--seconds 30 --only recorder" for one of them

Each node runs beside two bare ones: one that ``rclpy.spin`` serves, and one that takes all that waits at once and rests
between two looks. Times are of the processor, of the process and its children. Then all nodes run at once with the
simulated cell, and it is measured how old a pose is when the calibrator has taken it in, and when the bare one has.
Ends with exit code 1 where a node costs more than five points of a core above the bare node that is spun; the estimator
of articulation, which weighs kinds of joints with each pose, has no limit.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import contextlib  # noqa: E402
import json  # noqa: E402
import signal  # noqa: E402
import subprocess  # noqa: E402
import sys  # noqa: E402
import tempfile  # noqa: E402
import time  # noqa: E402
from collections.abc import Iterator  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(ROOT / "tests"))

import conftest  # noqa: E402, F401 (finds the install tree)
from nodes.cell import Said  # noqa: E402
from nodes.processes import EXECUTABLES, environment, fresh_domain, listener  # noqa: E402

ABOVE = 5.0  # points of a core
LATE_MS = 50.0
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


def chain(seconds: float, folder: Path) -> dict[str, Any]:
    """All nodes at once with the simulated cell: shares, and how old poses are, for the calibrator and the bare one."""
    domain = fresh_domain()
    folder.mkdir()
    with contextlib.ExitStack() as stack:
        processes = {name: stack.enter_context(node(name, domain, folder)) for name in NODES}
        bare = script("bare", "spin", str(folder / "spin.json"), domain=domain, folder=folder)
        processes["bare, spun"] = stack.enter_context(bare)
        heard, wait = stack.enter_context(listener(domain))
        said = Said(heard)
        time.sleep(6.0)
        settings = {"urdf": URDF, "seed": 3, "stations": 100, "repeat": True, "joint_rate_hz": 1000.0,
                    "tracker_rate_hz": 200.0}  # fmt: skip
        words = [word for k, v in settings.items() for word in ("-p", f"{k}:={v}")]
        command = [str(EXECUTABLES / "simulated_cell"), "--ros-args", *words]
        processes["simulated_cell"] = stack.enter_context(started(command, domain, folder))
        used = shares(processes, 10.0, seconds)
        last = time.monotonic()
        wait(lambda: time.monotonic() > last + 2.0, 10.0)
        samples = {v.key: v.value for v in said.last["/calibrator: samples"].values}
    bare_ms = json.loads((folder / "spin.json").read_text())["late_ms"]
    calibrator_ms = [float(samples[f"from stamp to update, {key} [ms]"]) for key in ("median", "p99")]
    return {"used": used, "bare_ms": bare_ms, "calibrator_ms": calibrator_ms}


def main() -> int:
    """Print the tables; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--only", default="", help="one node, or chain")
    asked = parser.parse_args()
    broken = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        modcal = Path(sys.executable).with_name("modcal")
        made = (str(modcal), "calibrate", str(ROOT / "bags" / "ur10_cell"), "--out", str(folder / "calibration"))
        subprocess.run(made, check=True, stdout=subprocess.DEVNULL)
        print(
            "| node | % of a core | bare, spun | bare, with rests | above the spun one | source |\n"
            + 6 * "| --- "
            + "|"
        )
        for each in NODES:
            if asked.only in ("", each):
                used = cost(each, asked.seconds, folder / each)
                above = used["node"] - used["spin"]
                broken += above > ABOVE
                row = [used["node"], used["spin"], used["rest"], above, used["source"]]
                print("| " + " | ".join([each, *(f"{x:.1f}" for x in row)]) + " |", flush=True)
        if asked.only in ("", "chain"):
            made = chain(8.0 * asked.seconds, folder / "chain")  # so that how the nodes begin is below a hundredth
            print("\nAll at once, % of a core: " + ", ".join(f"{k} {v:.1f}" for k, v in made["used"].items()))
            print("stamp to taken, ms, median and p99: bare {:.2f} {:.2f}".format(*made["bare_ms"]), end="; ")
            print("calibrator {:.2f} {:.2f}".format(*made["calibrator_ms"]))
            broken += made["calibrator_ms"][1] > max(LATE_MS, made["bare_ms"][1])
    return int(broken > 0)


if __name__ == "__main__":
    sys.exit(main())

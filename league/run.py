"""Run methods on tasks, one process each, and write a JSON for each pair; then the page.

    python -m league.run [--full] [--data FOLDER] [--only METHOD_OR_TASK …] [--again] [--workers N] [--out FOLDER]

Pairs are spread over the cores by Dask. A result that is there already for the same task and version is kept, unless
--again.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import dask
import numpy as np

from league import page
from league.methods import METHODS
from league.score import problems_of, result
from league.tasks import FULL, FURTHER, SMALL, Problem, problem

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
ENVIRONMENTS = ROOT / ".venv-league"
PATIENCE = {False: 600.0, True: 3600.0}  # s of one method on one task, in the small and the full edition
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def answered(problem: Problem, method: str, patience: float) -> dict[str, Any]:
    """The result of a method on a task, by a process of its own that has one core and no scored reading."""
    python = ENVIRONMENTS / METHODS[method]["environment"] / "bin" / "python"
    said: dict[str, Any] = {"status": "failed", "version": "", "cpu_s": 0.0, "memory_mb": 0.0}
    arrays = {}
    with tempfile.TemporaryDirectory(prefix="league_") as folder:
        told, out = Path(folder) / "task.npz", Path(folder) / "answer.npz"
        problem.task.write(told)
        environment = {**os.environ, **dict.fromkeys(THREADS, "1"), "PYTHONPATH": str(ROOT)}
        command = [str(python), "-m", "league.child", method, str(told), str(out)]
        try:
            done = subprocess.run(
                command, env=environment, cwd=folder, timeout=patience, capture_output=True, text=True
            )
            said["remark"] = (done.stderr.strip().splitlines() or ["no answer"])[-1][:300]
        except FileNotFoundError:
            said |= {"status": "not applicable", "remark": "could not be installed here"}
        except subprocess.TimeoutExpired:
            said |= {"status": "stopped", "remark": f"not done after {patience:.0f} s", "cpu_s": patience}
        if out.exists():
            with np.load(out) as data:
                arrays = {name: data[name] for name in data.files if name != "said"}
                said |= json.loads(str(data["said"]))
    return result(problem, method, said, arrays)


def kept(problem: Problem, method: str, patience: float, file: Path) -> bool:
    """Run a method on a task, write its result, say it, and return whether it failed."""
    found = answered(problem, method, patience)
    assert not (wrong := problems_of(found)), wrong
    lines = (f" {json.dumps(key)}: {json.dumps(value)}" for key, value in found.items())
    file.write_text("{\n" + ",\n".join(lines) + "\n}\n")
    size = f"{found['rms_mm']:.4f} mm RMS" if "rms_mm" in found else f"{found['status']}: {found['remark']}"
    print(f"{found['task']} {method}: {size}, {found['cpu_s']} s", flush=True)
    return found["status"] == "failed"


def chosen(names: tuple[str, ...], only: list[str]) -> tuple[str, ...]:
    """The names that are asked for; all where none of them is."""
    return tuple(name for name in names if name in only) or names


def main() -> int:
    """Run what is asked for; 1 where a method failed."""
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--full", action="store_true", default=os.environ.get("LEAGUE") == "full")
    made.add_argument("--data", type=Path, help="folder with the recordings that are not in the repository")
    made.add_argument("--only", nargs="+", default=[])
    made.add_argument("--again", action="store_true")
    made.add_argument("--workers", type=int, default=os.cpu_count(), help="methods that run at once")
    made.add_argument("--out", type=Path, default=HERE / "results")
    given = made.parse_args()
    known = FULL if given.full else SMALL + (FURTHER if given.data else ())
    tasks, methods = chosen(known, given.only), chosen(tuple(METHODS), given.only)
    given.out.mkdir(parents=True, exist_ok=True)
    jobs = []
    for task in tasks:
        try:
            one = problem(task, given.data)
        except FileNotFoundError as missing:
            print(f"{task}: left out: {missing}", file=sys.stderr)
            continue
        for method in (m for m in methods if one.task.kind in METHODS[m]["kinds"].split()):
            file = given.out / f"{task}.{method}.json"
            if given.again or not file.exists() or json.loads(file.read_text())["digest"] != one.task.digest:
                jobs.append(dask.delayed(partial(kept, one, method, PATIENCE[given.full], file))())
    failed = sum(dask.compute(*jobs, scheduler="threads", num_workers=given.workers))
    print(page.write(given.out, ROOT / "build" / "league", given.data))
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())

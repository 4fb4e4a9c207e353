"""Can modcal name what nobody declared? Recordings of arms with planted faults, analysed one by one, and a table.

    python bench/undeclared/run.py --scenarios compliance,gear_harmonic --seeds 6 --clean-runs 0

The truth comes from MuJoCo and from generators of this folder, and the analysis is given paths of bags only.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import contextlib  # noqa: E402
import io  # noqa: E402
import json  # noqa: E402
import multiprocessing  # noqa: E402
import sys  # noqa: E402
import tempfile  # noqa: E402
import time  # noqa: E402
import traceback  # noqa: E402
from collections import Counter  # noqa: E402
from concurrent.futures import ProcessPoolExecutor, as_completed  # noqa: E402
from dataclasses import asdict  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402
from arm import ROBOTS  # noqa: E402
from recordings import STATIONS, make  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402
from scenarios import SCENARIOS  # noqa: E402
from scipy.stats import beta  # noqa: E402
from score import score  # noqa: E402

Result = dict[str, Any]


def one(scenario: str, robot: str, seed: int, stations: int, keep: Path | None) -> Result:
    """Record, calibrate on the first recording, predict the second, and score."""
    result: Result = {"scenario": scenario, "robot": robot, "seed": seed, "failed": None}
    with contextlib.ExitStack() as stack:
        if keep is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="undeclared_")))
        else:
            folder = keep / scenario.replace("+", "_and_") / f"{robot}_{seed}"
        try:
            pair = make(scenario, robot, seed, folder, stations)
        except Exception:
            return result | {"failed": "recordings: " + traceback.format_exc(limit=-2)}
        truth = json.loads(pair.truth.read_text(encoding="utf-8"))
        result |= {"truth": truth}
        out, predicted = folder / "calibrated", folder / "predicted"
        begin = time.perf_counter()
        failure = _modcal("calibrate", str(pair.first), "--out", str(out))
        result["seconds"] = time.perf_counter() - begin
        if failure:
            return result | {"failed": f"calibrate: {failure}"}
        report = json.loads((out / "report.json").read_text(encoding="utf-8"))
        result |= {"effects": report.get("effects") or [], "unexplained": report.get("unexplained")}
        result |= {"error_mm": report["error_mm"], "score": asdict(s := score(report, truth))}
        result["attributed"] = s.attributed
        if failure := _modcal("evaluate", str(out / "calibration.yaml"), str(pair.second), "--out", str(predicted)):
            return result | {"failed": f"evaluate: {failure}"}
        report = json.loads((predicted / "report.json").read_text(encoding="utf-8"))
        result["error_over_floor"] = report["error_mm"]["final"]["rms"] / truth["floor_mm_second"]
        return result


def _modcal(*arguments: str) -> str:
    """Why the command failed; empty when it did not."""
    from modcal_nodes.cli.main import run

    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = run(list(arguments))
    return "" if code == 0 else f"exit {code}: {said.getvalue().strip()[-800:]}"


def table_of(results: list[Result]) -> Table:
    """A row a scenario: what was named, what was named falsely, and how well the second recording is predicted."""
    table = Table(title="Undeclared effects: were they named, and is the next recording predicted?")
    table.add_column("scenario")
    for header in ("runs", "attributed", "false", "failed", "error ÷ floor", "worst", "s"):
        table.add_column(header, justify="right")
    table.add_column("named most often")
    rows = [(name, [r for r in results if r["scenario"] == name]) for name in SCENARIOS]
    rows = [row for row in rows if row[1]]
    for name, runs in rows:
        table.add_row(*_row(name, runs))
    table.add_section()
    planted = [r for r in results if r.get("truth", {}).get("effects")]
    if planted:
        table.add_row(*_row("all with a planted effect", planted))
    if any(not r.get("truth", {"effects": 1})["effects"] for r in results):
        table.add_row(*_row("all without", [r for r in results if not r.get("truth", {"effects": 1})["effects"]]))
    return table


def _row(name: str, runs: list[Result]) -> list[str]:
    scored = [r for r in runs if "score" in r]
    named = Counter(n for r in scored for n in r["score"]["named"])
    silent = sum(not r["score"]["entries"] for r in scored)
    common = [*([("silence", silent)] if silent else []), *named.most_common(3)]
    over = [r["error_over_floor"] for r in runs if "error_over_floor" in r]
    return [
        name,
        str(len(runs)),
        f"{100 * sum(r.get('attributed', False) for r in runs) / len(runs):.0f} %",
        str(sum(r["score"]["false"] for r in scored)),
        str(sum(r["failed"] is not None for r in runs)),
        f"{np.median(over):.2f}" if over else "–",
        f"{max(over):.2f}" if over else "–",
        f"{np.median([r['seconds'] for r in runs if 'seconds' in r] or [np.nan]):.1f}",
        ", ".join(f"{what} ({count})" for what, count in sorted(common, key=lambda c: -c[1])[:3]),
    ]


def false_discoveries(results: list[Result]) -> str:
    """How often a recording without an identifiable effect had one named, with the upper 95 % bound."""
    clean = [r for r in results if "score" in r and not r["truth"]["effects"]]
    k, n = sum(r["score"]["entries"] > 0 for r in clean), len(clean)
    if not n:
        return ""
    upper = 1.0 if k == n else float(beta.ppf(0.95, k + 1, n - k))
    return f"{k} of {n} recordings without an identifiable effect had one named; with 95 % confidence below {upper:.1%}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenarios", default=",".join(SCENARIOS), help="comma-separated; default: all")
    parser.add_argument("--robots", default=",".join(ROBOTS), help="comma-separated; seeds go round them")
    parser.add_argument("--seeds", type=int, default=10, help="runs of each scenario")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--clean-runs", type=int, default=300, help="runs of the scenario none")
    parser.add_argument("--stations", type=int, default=STATIONS, help="of the first recording")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--keep", type=Path, default=None, metavar="DIR", help="keep bags, truth and results")
    parser.add_argument("--json", type=Path, default=None, metavar="FILE", help="a line of JSON a run")
    given = parser.parse_args()
    names, robots = given.scenarios.split(","), given.robots.split(",")
    for kind, wanted, known in (("scenario", names, SCENARIOS), ("robot", robots, ROBOTS)):
        if missing := [n for n in wanted if n not in known]:
            parser.error(f"no {kind} {', '.join(missing)}; there are {', '.join(known)}")
    tasks = [
        (name, robots[seed % len(robots)], seed)
        for name in names
        for seed in range(given.first_seed, given.first_seed + (given.clean_runs if name == "none" else given.seeds))
    ]
    results: list[Result] = []
    log = given.json.open("w", encoding="utf-8") if given.json else None
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(given.jobs, mp_context=context) as pool:
        waiting = {pool.submit(one, *task, given.stations, given.keep): task for task in tasks}
        for done, future in enumerate(as_completed(waiting), 1):
            name, robot, seed = waiting[future]
            try:
                result = future.result()
            except Exception as error:
                result = {"scenario": name, "robot": robot, "seed": seed, "failed": repr(error)}
            results.append(result)
            print(f"[{done}/{len(tasks)}] {name} {robot} {seed}: {_line(result)}", file=sys.stderr, flush=True)
            if log:
                log.write(json.dumps(result) + "\n")
                log.flush()
    if log:
        log.close()
    console = Console(width=None if sys.stdout.isatty() else 160)
    console.print(table_of(results))
    console.print(false_discoveries(results))
    failed = [r for r in results if r["failed"] is not None]
    for r in failed:
        console.print(f"failed: {r['scenario']} {r['robot']} {r['seed']}: {r['failed']}", markup=False, soft_wrap=True)
    return 1 if failed else 0


def _line(result: Result) -> str:
    if result["failed"] is not None:
        return "FAILED " + result["failed"].splitlines()[-1]
    s = result["score"]
    found = "named" if result["attributed"] else f"{s['matched']} of {s['planted']} named"
    false = f", {s['false']} false" if s["false"] else ""
    return f"{found}{false}, error ÷ floor {result['error_over_floor']:.2f}, {result['seconds']:.1f} s"


if __name__ == "__main__":
    sys.exit(main())

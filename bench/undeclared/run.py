"""Can modcal name what nobody declared? Recordings of arms with planted faults, analysed one by one, and a table.

    make bench NAME=undeclared ARGS="--only compliance gear_harmonic --seeds 6 --clean-runs 0"

The truth comes from MuJoCo and from generators of this folder, and the analysis is given paths of bags only.
How much each fault moves the tool stands among the results as ``truth.sizes``.
"""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import asdict
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import harness

# isort: split
import json

import numpy as np
from arms import ROBOTS
from recordings import STATIONS, make
from scenarios import SCENARIOS
from score import score


def one(task: harness.Task) -> harness.Result:
    """Record, calibrate on the first recording, predict the second, and score."""
    scenario, robot, seed = task["scenario"], task["robot"], task["seed"]
    keep = task["keep"] and Path(task["keep"]) / scenario.replace("+", "_and_") / f"{robot}_{seed}"
    with harness.scratch(keep) as folder:
        first, second, told = make(scenario, robot, seed, folder, task["stations"])
        truth = json.loads(told.read_text(encoding="utf-8"))
        out, predicted = folder / "calibrated", folder / "predicted"
        harness.succeeded("calibrate", first, "--out", out)
        report = harness.report_of(out)
        s = score(report, truth)
        harness.succeeded("evaluate", out / "calibration.yaml", second, "--out", predicted)
        left = harness.report_of(predicted)["error_mm"]["final"]["rms"]
    out = {"planted": bool(truth["effects"]), "truth": truth, "score": asdict(s), "attributed": s.attributed}
    out |= {key: report[key] for key in ("effects", "error_mm", "unexplained")}
    return {**out, "error_over_floor": left / truth["floor_mm_second"]}


def row(name: str, runs: list[harness.Result]) -> list[object]:
    """What was named, what was named falsely, and how well the second recording is predicted."""
    scored = [r for r in runs if not r["failed"]]
    common = Counter(n for r in scored for n in r["score"]["named"] or ["silence"]).most_common(3)
    over = [r["error_over_floor"] for r in scored] or [np.nan]
    named, false = sum(r["attributed"] for r in scored) / len(runs), sum(r["score"]["false"] for r in scored)
    told = f"{np.median(over):.2f}", f"{max(over):.2f}", f"{np.median([r['cpu_s'] for r in runs]):.1f}"
    words = ", ".join(f"{what} ({count})" for what, count in common)
    return [name, len(runs), f"{named:.0%}", false, len(runs) - len(scored), *told, words]


def show(results: list[harness.Result]) -> None:
    """The table, and how often a recording without an identifiable effect had one named."""
    scored = [r for r in results if not r["failed"]]
    groups = {name: [r for r in results if r["scenario"] == name] for name in SCENARIOS}
    groups |= {"all with a planted effect": [r for r in scored if r["planted"]]}
    groups |= {"all without": [r for r in scored if not r["planted"]]}
    heads = ("scenario", "runs", "attributed", "false", "failed", "error ÷ floor", "worst", "CPU s", "named most often")
    rows = [row(name, runs) for name, runs in groups.items() if runs]
    harness.table("Undeclared effects: were they named, and is the next recording predicted?", heads, rows)
    if clean := [bool(r["score"]["entries"]) for r in groups["all without"]]:
        upper = harness.interval(sum(clean), len(clean), 0.90)[1]
        words = "recordings without an identifiable effect had one named"
        harness.say(f"{harness.share(clean)} {words} (95 %: < {upper:.1%})")


def line(r: harness.Result) -> str:
    s = r["score"]
    found = "named" if r["attributed"] else f"{s['matched']} of {s['planted']} named"
    return f"{found}, {s['false']} false, error ÷ floor {r['error_over_floor']:.2f}"


def main() -> int:
    """Exit code: 0 where no run failed."""
    parser = harness.parser(__doc__, seeds=10, names=SCENARIOS)
    parser.add_argument("--robots", default=",".join(ROBOTS), help="comma-separated; seeds go round them")
    parser.add_argument("--clean-runs", type=int, default=300, help="runs of the scenario none")
    parser.add_argument("--stations", type=int, default=STATIONS, help="of the first recording")
    parser.add_argument("--keep", default=None, metavar="DIR", help="keep bags, truth and results")
    given = harness.parsed(parser)
    robots = harness.chosen(ROBOTS, [given.robots])
    told = {"stations": given.stations, "keep": given.keep}
    tasks = [
        {"scenario": name, "robot": robots[seed % len(robots)], "seed": seed, **told}
        for name in given.names
        for seed in range(given.first, given.first + (given.clean_runs if name == "none" else given.seeds))
    ]
    results = harness.each(one, tasks, given, line)
    show(results)
    return int(bool(harness.failures(results)))


if __name__ == "__main__":
    sys.exit(main())

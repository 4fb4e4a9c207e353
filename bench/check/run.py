"""Does ``modcal.check`` name what changed, by ten stations? Cells of MuJoCo, one thing planted, and a table.

    python bench/check/run.py --cells 12 --each 5 --out /tmp/check.jsonl

Each cell is calibrated from 160 stations once. Results are appended to the file as they come, and a run that is
interrupted goes on where it was; ``--table`` only prints.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import json  # noqa: E402
import time  # noqa: E402
from collections.abc import Iterator  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402
from cells import KINDS, STATIONS, TIMES, Change, Readings, Workplace, planted, workplace  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402
from scipy.stats import beta  # noqa: E402

import modcal_core as modcal  # noqa: E402
from modcal_core.checking.accuracy import expected_error  # noqa: E402
from modcal_core.checking.known import pattern_of  # noqa: E402
from modcal_core.checkup import Checked  # noqa: E402
from modcal_core.errors import ModcalError  # noqa: E402

ROBOTS = ("ur10", "panda", "xarm7")
SETUPS = ("tracker", "points", "camera")
FRESH = 200  # postures at which models are compared with the truth
Result = dict[str, Any]


def samples_of(place: Workplace, readings: Readings, begin: float) -> modcal.Samples:
    """What a user would hand over: points of a tracker, poses, or poses of the board that a camera on the hand sees."""
    names, stamps = place.cell.arm.names, begin + 2.0 * np.arange(len(readings.q))
    if place.points:
        return modcal.Samples.from_arrays(readings.q, points=readings.p, names=names, stamps=stamps)
    T = np.tile(np.eye(4), (len(readings.q), 1, 1))
    T[:, :3, 3], T[:, :3, :3] = readings.p, readings.R.as_matrix()
    return modcal.Samples.from_arrays(readings.q, poses=T, names=names, stamps=stamps)


def calibrated(place: Workplace, q: np.ndarray, rng: np.random.Generator, changes: tuple[Change, ...]) -> Any:
    """The result of calibrating from these postures."""
    robot = modcal.Robot.from_urdf(place.cell.arm.urdf, tip=place.cell.arm.tip)
    return modcal.calibrate(robot, samples_of(place, place.measure(q, rng, changes), 1.7e9), seed=0)


def pattern(result: Any) -> float:
    """What ``modcal check`` takes from the report beside a calibration."""
    share = result.report.judged.predictable
    return pattern_of(None if share is None else share.share)


def miss(calibration: modcal.Calibration, readings: Readings, exact: bool) -> float:
    """RMS distance [mm] between predictions and readings, or the exact positions."""
    p = calibration.predict(readings.q)[:, :3, 3]
    return 1e3 * float(np.sqrt(np.mean(np.sum((p - (readings.exact_p if exact else readings.p)) ** 2, axis=1))))


def one(
    place: Workplace, before: Any, kind: str, rng: np.random.Generator, stations: int, full: bool, follow: bool
) -> Result:
    """One check after one change, its score, and how well the repaired model does."""
    arm = place.cell.arm
    q = rng.uniform(*arm.range, (stations, arm.n))
    changes = () if kind == "nothing" else (planted(place, kind, q, rng),)
    right = {name for change in changes for name in change.names}
    if place.camera:
        right = {("tool", "tool")} if kind == "camera" else right
    seen = place.measure(q, rng, changes)
    calibration, share = before.calibration, pattern(before)
    begin = time.process_time()
    samples = samples_of(place, seen, 1.71e9)
    try:
        found = modcal.check(calibration, samples, pattern=share)
    except ModcalError as error:
        none: Result = {"named": False, "first": False, "others": 0, "same_as": [], "status": "refused", "changes": []}
        return {**none, "seconds": time.process_time() - begin, "right": sorted(map(list, right)), "said": str(error)}
    seconds = time.process_time() - begin
    result: Result = {"seconds": seconds, "right": sorted(map(list, right)), **said(found)}
    labels = {(c.kind, c.place): (c.label, *c.same_as) for c in found.changes}
    named = [key for key, names in labels.items() if key in right or right_label(right) & set(names)]
    result["named"] = bool(named) if changes else not found.changes and found.status == "unchanged"
    result["first"] = any(key in right for key in labels)
    result["others"] = len(found.changes) - len(named)
    result["same_as"] = [len(c.same_as) for c in found.changes]
    if full and changes and found.repaired is not None:
        fresh = place.measure(rng.uniform(*arm.range, (FRESH, arm.n)), rng, changes)
        again = calibrated(place, rng.uniform(*arm.range, (STATIONS, arm.n)), rng, changes).calibration
        for name, model in (("old", calibration), ("repaired", found.repaired), ("full", again)):
            result[f"{name}_mm"] = miss(model, fresh, exact=False)
            result[f"{name}_true_mm"] = miss(model, fresh, exact=True)
            expected = expected_error(model, model.calibrated, samples, fresh.q)
            result[f"{name}_expected_mm"] = None if expected is None else 1e3 * expected
    if follow and changes and len(found.advice.stations):
        result["added"] = followed(place, calibration, share, found, seen, changes, rng, right)
    return result


def followed(
    place: Workplace,
    calibration: modcal.Calibration,
    share: float,
    found: Checked,
    seen: Readings,
    changes: tuple[Change, ...],
    rng: np.random.Generator,
    right: set[tuple[str, str]],
) -> Result:
    """The same after the proposed stations were measured as well."""
    more = place.measure(np.concatenate([seen.q, found.advice.stations]), rng, changes)
    again = modcal.check(calibration, samples_of(place, more, 1.72e9), pattern=share)
    result = {"stations": len(more.q), **said(again)}
    result["first"] = any((c.kind, c.place) in right for c in again.changes)
    return result


def right_label(right: set[tuple[str, str]]) -> set[str]:
    """How what is right is called."""
    words = {"joint_zero": "zero of {}", "gear": "gear of {}", "tracker_scale": "scale of the {}"}
    words |= {"tracker_noise": "noise of the {}", "base": "base", "tool": "tool"}
    return {words[kind].format(place) for kind, place in right}


def said(found: Checked) -> Result:
    """What a check said."""
    return {
        "status": found.status,
        "changes": [[c.kind, c.place, *c.same_as] for c in found.changes],
        "aside": len(found.aside),
        "action": found.advice.action,
        "repaired": found.repaired is not None,
    }


def runs(cells: int, each: int, nothing: int, setups: tuple[str, ...]) -> Iterator[tuple[str, str, int, str, int]]:
    """(setup, robot, seed, kind, number) of all checks, in rounds, so that a table grows evenly."""
    for seed in range(cells):
        robot = ROBOTS[seed % len(ROBOTS)]
        for setup in setups:
            kinds = ("camera", "base", "joint_zero", "gear") if setup == "camera" else KINDS
            for i in range(nothing):
                yield setup, robot, seed, "nothing", i
            for kind in kinds:
                for i in range(each):
                    yield setup, robot, seed, kind, i


def interval(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a share (Clopper & Pearson 1934)."""
    low = 0.0 if hits == 0 else float(beta.ppf(0.025, hits, count - hits + 1))
    high = 1.0 if hits == count else float(beta.ppf(0.975, hits + 1, count - hits))
    return low, high


def table(results: list[Result]) -> Table:
    """The score by setup and kind."""
    head = ("setup", "planted", "checks", "named or among same_as", "95 %", "named first", "something else named too")
    out = Table(*head, "same_as, mean", "repaired ÷ full, noisy", "÷ full, truth", "by covariances", "s")
    for setup in SETUPS:
        for kind in ("nothing", *KINDS, "camera"):
            part = [r for r in results if r["setup"] == setup and r["kind"] == kind]
            if not part:
                continue
            hits = sum(r["named"] for r in part)
            low, high = interval(hits, len(part))
            ratio = [r["repaired_mm"] / r["full_mm"] for r in part if "full_mm" in r]
            true = [r["repaired_true_mm"] / r["full_true_mm"] for r in part if "full_mm" in r]
            told = [r["repaired_expected_mm"] / r["full_expected_mm"] for r in part if r.get("full_expected_mm")]
            wide = [n for r in part for n in r["same_as"]]
            out.add_row(
                *(setup, kind, str(len(part)), f"{hits / len(part):.1%}", f"{low:.1%} … {high:.1%}"),
                f"{sum(r['first'] for r in part) / len(part):.0%}" if kind != "nothing" else "",
                f"{sum(r['others'] > 0 for r in part) / len(part):.1%}",
                f"{np.mean(wide):.2f}" if wide else "",
                f"{np.median(ratio):.2f}, worst {max(ratio):.2f}" if ratio else "",
                f"{np.median(true):.2f}" if true else "",
                f"{np.median(told):.2f}" if told else "",
                f"{np.median([r['seconds'] for r in part]):.2f}",
            )
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=12)
    parser.add_argument("--each", type=int, default=5, help="checks of each kind in a cell")
    parser.add_argument("--nothing", type=int, default=25, help="checks in a cell while nothing has changed")
    parser.add_argument("--setups", default=",".join(SETUPS), help="some of them, separated by commas")
    parser.add_argument("--stations", type=int, default=10)
    parser.add_argument("--full", type=int, default=1, help="of each kind in a cell, beside a full recalibration")
    parser.add_argument("--follow", action="store_true", help="measure the proposed stations too, and check again")
    parser.add_argument("--seed", type=int, default=0, help="another seed is another set of cells")
    parser.add_argument("--out", type=Path, default=Path("check.jsonl"))
    parser.add_argument("--table", action="store_true")
    asked = parser.parse_args()
    done = [json.loads(line) for line in asked.out.read_text().splitlines()] if asked.out.is_file() else []
    key = ("setup", "robot", "seed", "kind", "number")
    have = {tuple(r[k] for k in key) for r in done}
    now: tuple[Any, ...] = ()
    for run in runs(asked.cells, asked.each, asked.nothing, tuple(asked.setups.split(","))) if not asked.table else ():
        setup, robot, number, kind, i = run
        seed = number + 1000 * asked.seed
        if (setup, robot, seed, kind, i) in have:
            continue
        if now != (setup, robot, seed):
            now = setup, robot, seed
            place, rng = workplace(robot, seed, camera=setup == "camera", points=setup == "points")
            arm = place.cell.arm
            before = calibrated(place, rng.uniform(*arm.range, (STATIONS, arm.n)), rng, ())
        own = np.random.default_rng([seed, i, SETUPS.index(setup), sum(map(ord, kind))])
        result = {**dict(zip(key, (setup, robot, seed, kind, i), strict=True)), "times": TIMES}
        result |= one(place, before, kind, own, asked.stations, i < asked.full, asked.follow)
        done.append(result)
        with asked.out.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(result) + "\n")
    Console(width=200).print(table(done))


if __name__ == "__main__":
    main()

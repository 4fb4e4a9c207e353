"""Does ``modcal.check`` name what changed, by ten stations? Cells of MuJoCo, one thing planted; and real readings.

    make bench NAME=check ARGS="--only points --seeds 3 --each 5"

tracker, points, camera: each cell is calibrated from 160 stations once (poses, points, or a board that a camera on the
hand sees), then checked after one change of three times the floor. months: does ``modcal history`` see a gear's curve
grow by a fifth in four months? real: series A of the IPA's UR10, calibrated from 662 of its stations and checked by ten
others, at random or neighbours, as they are or moved as by a base, a tool or a joint's zero; and series D, another day.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import harness

# isort: split
import time
from collections import Counter
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import recorded
from cells import KINDS, Workplace, at_joint, calibrated, distance, planted, samples_of, workplace
from scipy.spatial.transform import Rotation

import modcal_core as modcal
from modcal_core.calibration.cell import Cell
from modcal_core.calibration.store import Calibration
from modcal_core.checking.known import pattern_of
from modcal_core.checkup import Checked
from modcal_core.claim.claim import claim_at_tool
from modcal_core.errors import ModcalError
from modcal_core.geometry import se3
from modcal_core.measurements.samples import Samples
from modcal_nodes.cli.history import read_history

ROBOTS, SETUPS = ("ur10", "panda", "xarm7"), ("tracker", "points", "camera")
CAMERA_KINDS = ("camera", "base", "joint_zero", "gear")
FRESH = 200  # postures at which models are compared with the truth
WORDS = {"joint_zero": "zero of {}", "gear": "gear of {}", "base": "base", "tool": "tool"}
WORDS |= {"tracker_scale": "scale of the {}", "tracker_noise": "noise of the {}"}
MONTHS, MONTH, BEGIN, EACH_MONTH = 5, timedelta(days=30.44), datetime(2026, 3, 1, tzinfo=UTC), 80
AMPLITUDE, GROWTH = 4e-4, 0.05  # of the gear's curve that grows [rad]; a month
CALIBRATED, TEN, MOVED = 662, 10, 3.0  # of series A: stations; of a check; times the spread, RMS at the tool


def one(task: harness.Task) -> harness.Result:
    """All checks of one cell."""
    part = {"real": real, "months": months}.get(task["part"], cell)
    return part(task)


def cell(task: harness.Task) -> harness.Result:
    """A cell that is calibrated once and checked after one change after the other."""
    setup, seed = task["part"], task["seed"]
    place, rng = workplace(task["robot"], seed, camera=setup == "camera", points=setup == "points")
    before = calibrated(place, place.postures(rng), rng, ())
    checks = []
    for kind in ("nothing", *(CAMERA_KINDS if setup == "camera" else KINDS)):
        for i in range(task["nothing"] if kind == "nothing" else task["each"]):
            own = np.random.default_rng([seed, i, SETUPS.index(setup), sum(map(ord, kind))])
            checks.append({"kind": kind, **checked(place, before, kind, own, task, full=i < task["full"])})
    return {"checks": checks}


def checked(
    place: Workplace, before: Any, kind: str, rng: np.random.Generator, task: harness.Task, full: bool
) -> harness.Result:
    """One check after one change, its score, and how well the repaired model does."""
    calibration, q = before.calibration, place.postures(rng, task["stations"])
    changes = () if kind == "nothing" else (planted(place, kind, q, rng),)
    right = {("tool", "tool")} if kind == "camera" else {name for change in changes for name in change.names}
    seen, share = place.measure(q, rng, changes), before.report.judged.predictable
    share = pattern_of(None if share is None else share.share)
    samples, began = samples_of(place, seen, 1.71e9), time.process_time()
    try:
        found = modcal.check(calibration, samples, pattern=share)
    except ModcalError as error:
        return {"named": False, "first": False, "others": 0, "status": "refused", "said": str(error)}
    result = {"seconds": time.process_time() - began, **said(found)}
    labels = {(c.kind, c.place): {c.label, *c.same_as} for c in found.changes}
    words = {WORDS[what].format(where) for what, where in right}
    named = [key for key, names in labels.items() if key in right or words & names]
    result["named"] = bool(named) if changes else not found.changes and found.status == "unchanged"
    result["first"], result["others"] = any(key in right for key in labels), len(found.changes) - len(named)
    result["same_as"] = [len(c.same_as) for c in found.changes]
    if full and changes and found.repaired is not None:
        fresh = place.measure(place.postures(rng, FRESH), rng, changes)
        again = calibrated(place, place.postures(rng), rng, changes).calibration
        for name, model in (("old", calibration), ("repaired", found.repaired), ("full", again)):
            p = model.predict(fresh.q)[:, :3, 3]
            result[f"{name}_mm"], result[f"{name}_true_mm"] = distance(p, fresh.p), distance(p, fresh.exact_p)
            claim = claim_at_tool(model, samples, Cell(), fresh.q, frozen=True)
            result[f"{name}_expected_mm"] = claim.mm["rms"].value
    if task["follow"] and changes and len(found.advice.stations):
        more = place.measure(np.concatenate([seen.q, found.advice.stations]), rng, changes)
        after = modcal.check(calibration, samples_of(place, more, 1.72e9), pattern=share)
        first = any((c.kind, c.place) in right for c in after.changes)
        result["added"] = {"stations": len(more.q), **said(after), "first": first}
    return result


def said(found: Checked) -> harness.Result:
    """What a check said."""
    changes = [[c.kind, c.place, *c.same_as] for c in found.changes]
    told = {"aside": len(found.aside), "action": found.advice.action, "repaired": found.repaired is not None}
    return {"status": found.status, "changes": changes, **told}


def months(task: harness.Task) -> harness.Result:
    """A gear's wave calibrated five times a month apart, set up again each time; in every second cell it grows."""
    place, rng = workplace(task["robot"], 3 * task["seed"])
    joint, cycles, phase = int(rng.integers(1, 4)), int(rng.integers(1, 120)), rng.uniform(0, 2 * np.pi)
    growth, wave = GROWTH * (task["number"] % 2 == 0), at_joint(joint, lambda q: np.sin(cycles * q + phase))
    with harness.scratch() as folder:
        for month in range(MONTHS):
            place.old, when = (wave(AMPLITUDE * (1.0 + growth * month)),), BEGIN + month * MONTH
            q, way = place.postures(rng, EACH_MONTH), rng.normal(0.0, 0.1, 3)
            place.cell.tracker = place.cell.tracker[0] + way, place.cell.tracker[1] * Rotation.from_rotvec(way)
            found = calibrated(place, q, rng, (), when.timestamp())
            found.save(folder / f"{when:%Y-%m-%d}", page=False)
        (history,) = read_history(folder)
    name = f"curve of {place.cell.arm.names[joint]}"
    own = next((s for s in history.series if s.name == name), None)
    trends = [s for s in history.series if s.trend is not None]
    true = 1e3 * AMPLITUDE / np.sqrt(2.0) * growth * (MONTHS - 1)  # of the RMS of a wave over whole turns, nearly
    seen = bool(growth) and own is not None and own.trend is not None
    out: harness.Result = {
        "grows": bool(growth),
        "cycles": cycles,
        "true_mrad": true,
        "said": [s.sentence for s in trends],
    }
    out |= {"named": seen, "covered": seen and bool(own.trend.low <= true <= own.trend.high)}
    out |= {"false": sum(s is not own or not growth for s in trends)}
    return out


def real(task: harness.Task) -> harness.Result:
    """What was said of the UR10's series, by kind of check, in words, and how often."""
    with harness.scratch() as folder:
        robot, a = recorded.series("a", folder)
        d = replace(recorded.series("d", folder)[1], frames=a.frames)
        some = np.sort(np.random.default_rng(0).choice(len(a), CALIBRATED, replace=False))
        modcal.calibrate(robot, a.select(some), seed=0).save(folder / "kept", page=False)
        calibration, share = Calibration.load(folder / "kept"), harness.report_of(folder / "kept")["predictable"]
    pattern = pattern_of(None if share is None else share["share"])
    others, few = np.setdiff1d(np.arange(len(a)), some), max(task["each"] // 5, 1)
    rng = np.random.default_rng([task["seed"], 26])

    def ten(count: int, neighbours: bool) -> np.ndarray:
        if neighbours:
            first = int(rng.integers(count - TEN))
            return np.arange(first, first + TEN)
        return np.sort(rng.choice(count, TEN, replace=False))

    def words(samples: Samples, label: str = "") -> str:
        try:
            found = modcal.check(calibration, samples, pattern=pattern)
        except ModcalError as error:
            return f"refused: {str(error)[:100]}"
        names = [(c.label, *c.same_as) for c in found.changes]
        right = "right, " if any(label in some for some in names) else "another, " if label and names else ""
        return right + found.status + (": " + " + ".join(" | ".join(some) for some in names) if names else "")

    rows = []
    for neighbours in (False, True):
        for kind in ("nothing", "base", "tool", "joint_zero"):
            for _ in range(task["each"] if kind == "nothing" else few):
                samples, label = a.select(others[ten(len(others), neighbours)]), ""
                if kind != "nothing":
                    samples, label = moved(calibration, samples, kind, rng)
                rows.append([kind, "neighbours" if neighbours else "random", words(samples, label)])
    for neighbours in (False, True):
        for _ in range(few):
            said = words(d.select(ten(len(d), neighbours)))
            rows.append(["another day", "neighbours" if neighbours else "random", said])
    return {"pattern": pattern, "rows": [[*key, n] for key, n in Counter(map(tuple, rows)).most_common()]}


def moved(calibration: Calibration, samples: Samples, kind: str, rng: np.random.Generator) -> tuple[Samples, str]:
    """A change that moves the tool by three times the spread, put into readings; with what it is to be called."""
    chain, spread = calibration.nominal.serial, float(np.sqrt(3.0) * calibration.noise.position)
    T = se3.transform(samples.R, samples.reading)
    way, joint = rng.normal(size=6) * np.r_[np.ones(3), 2.0 * np.ones(3)], int(rng.integers(chain.n))

    def after(size: float) -> np.ndarray:
        if kind != "joint_zero":
            return se3.exp(size * way) @ T if kind == "base" else T @ se3.exp(size * way)
        q = samples.q.copy()
        q[:, joint] += size
        return calibration.predict(replace(samples, q=q)) @ se3.inverse(calibration.predict(samples)) @ T

    size = 1e-4
    for _ in range(3):
        rms = harness.rms(np.linalg.norm(after(size)[:, :3, 3] - T[:, :3, 3], axis=1))
        size = float(np.clip(size * MOVED * spread / max(rms, 1e-9), -0.05, 0.05))  # a zero that hardly moves the tool
    new = after(size)
    label = f"zero of {chain.names[joint]}" if kind == "joint_zero" else kind
    return replace(samples, reading=new[:, :3, 3], R=new[:, :3, :3]), label


def show(setup: str, checks: list[harness.Result]) -> None:
    """The score of one setup by kind."""

    def ratio(part: list[harness.Result], key: str) -> str:
        r = [c[f"repaired_{key}"] / c[f"full_{key}"] for c in part if c.get(f"full_{key}")]
        return f"{np.median(r):.2f}, {max(r):.2f}" if r else ""

    rows = []
    for kind in ("nothing", *KINDS, "camera"):
        part = [c for c in checks if c["kind"] == kind]
        if not part:
            continue
        hits, wide = sum(c["named"] for c in part), [n for c in part for n in c.get("same_as", ())]
        low, high = harness.interval(hits, len(part))
        shares = [f"{sum(c['first'] for c in part) / len(part):.0%}" if kind != "nothing" else ""]
        shares += [f"{sum(c['others'] > 0 for c in part) / len(part):.1%}", f"{np.mean(wide):.2f}" if wide else ""]
        ratios = [ratio(part, key) for key in ("mm", "true_mm", "expected_mm")]
        seconds = f"{np.median([c['seconds'] for c in part if 'seconds' in c] or [np.nan]):.2f}"
        rows.append([kind, len(part), f"{hits / len(part):.1%}", f"{low:.1%} … {high:.1%}", *shares, *ratios, seconds])
    heads = (
        "planted|checks|named or same_as|95 %|first|something else|same_as, mean|repaired ÷ full, worst|÷ full, truth"
    )
    harness.table(setup, [*heads.split("|"), "by covariances", "s"], rows)


def main() -> int:
    """Exit code: 0 where nothing failed."""
    parser = harness.parser(__doc__, seeds=12, names=(*SETUPS, "months", "real"))
    parser.add_argument("--each", type=int, default=5, help="checks of each kind in a cell")
    parser.add_argument("--nothing", type=int, default=25, help="checks in a cell while nothing has changed")
    parser.add_argument("--stations", type=int, default=TEN)
    parser.add_argument("--full", type=int, default=1, help="of each kind in a cell, beside a full recalibration")
    parser.add_argument("--follow", action="store_true", help="measure the proposed stations too, and check again")
    parser.add_argument("--real-each", type=int, default=150, help="checks of real readings where nothing has changed")
    given = harness.parsed(parser)
    told = {k: getattr(given, k) for k in ("each", "nothing", "stations", "full", "follow")}
    tasks = [
        {"part": part, "robot": ROBOTS[k % 3], "seed": given.first + k, "number": k, **told}
        for k in range(given.seeds)
        for part in given.names
        if part != "real"
    ]
    if "real" in given.names:
        harness.data()
        tasks.append({"part": "real", "seed": given.first, "each": given.real_each})
    results = harness.each(one, tasks, given)
    good = {part: [r for r in results if r["part"] == part and not r["failed"]] for part in given.names}
    for part, own in good.items():
        if part in SETUPS and own:
            show(part, [check for r in own for check in r["checks"]])
        elif part == "months" and own:
            grown = [r for r in own if r["grows"]]
            named, covered = (harness.share(r[k] for r in grown) for k in ("named", "covered"))
            false = sum(r["false"] for r in own)
            harness.say(f"growth named in {named}, its interval holds the truth in {covered}; {false} false trends")
        elif own:
            harness.table("Real readings", ("what", "ten stations", "said", "checks"), own[0]["rows"])
    return int(bool(harness.failures(results)))


if __name__ == "__main__":
    sys.exit(main())

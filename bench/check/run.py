"""Does ``modcal.check`` name what changed, by ten stations? Cells of MuJoCo, one thing planted; and real readings.

    make bench NAME=check ARGS="--only points --seeds 3 --each 5"

tracker, points, camera: each cell is calibrated from 160 stations once (poses, points, or a board that a camera on the
hand sees), then checked --each times after a change of three times the floor, and --nothing times without one; of each
kind the first --full are compared with a full recalibration. months: does ``modcal history`` see a gear's curve grow
by a fifth in four months? real: series A of the IPA's UR10, calibrated from 662 of its stations and checked by ten
others, at random or neighbours, as they are (--real-each times) or moved as by a base, a tool or a joint's zero; and
series D, another day. remounted: see remounted.py.
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
import remounted
from harness import over
from scipy.spatial.transform import Rotation
from workplace import KINDS, Workplace, at_joint, distance, drawn, planted

import modcal_core as modcal
from modcal_core.calibration.cell import Cell
from modcal_core.calibration.store import Calibration
from modcal_core.claim.claim import claim_at_tool
from modcal_core.errors import ModcalError
from modcal_core.geometry import se3
from modcal_core.measurements.samples import Samples
from modcal_core.moves.known import pattern_of
from modcal_nodes.cli.history import read_history

ARMS, SETUPS, NOTHING = ("ur10", "panda", "xarm7"), ("tracker", "points", "camera"), "nothing"
CHANGES = {"camera": ("camera", "base", "joint_zero", "gear")}
FRESH, TEN = 200, 10  # postures at which models are compared with the truth; stations of a check
WORDS = {"joint_zero": "zero of {}", "gear": "gear of {}", "base": "base", "tool": "tool"}
WORDS |= {"tracker_scale": "scale of the {}", "tracker_noise": "noise of the {}"}
MONTHS, MONTH, BEGIN, EACH_MONTH = 5, timedelta(days=30.44), datetime(2026, 3, 1, tzinfo=UTC), 80
AMPLITUDE, GROWTH = 4e-4, 0.05  # of the gear's curve that grows [rad]; a month
CALIBRATED, MOVED = 662, 3.0  # stations of series A; times the spread, RMS at the tool


def cell(task: harness.Task) -> harness.Result:
    setup, seed = task["part"], task["seed"]
    place, rng = drawn(task["robot"], seed, setup)
    before = place.calibrated(place.measure(place.postures(rng), rng), setup == "points")
    checks = []
    for kind in (NOTHING, *CHANGES.get(setup, KINDS)):
        for i in range(task["nothing" if kind == NOTHING else "each"]):
            own = np.random.default_rng([seed, i, SETUPS.index(setup), sum(map(ord, kind))])
            about = {"setup": setup, "kind": kind, "full": i < task["full"] and kind != NOTHING}
            checks.append({**about, **checked(place, before, about, own)})
    return {"checks": checks}


def checked(place: Workplace, before: Any, about: dict[str, Any], rng: np.random.Generator) -> harness.Result:
    """One check after one change, its score, and how well the repaired model does."""
    calibration, share, kind = before.calibration, before.report.judged.predictable, about["kind"]
    q, names, points = place.postures(rng, TEN), place.cell.arm.names, about["setup"] == "points"
    right, place = (None, place) if kind == NOTHING else planted(place, kind, q, rng)
    samples, began = place.measure(q, rng).samples(names, points, 1.71e9), time.process_time()
    try:
        found = modcal.check(calibration, samples, pattern=pattern_of(None if share is None else share.share))
    except ModcalError as error:
        return {"named": False, "first": False, "others": False, "status": "refused", "said": str(error)}
    out = {"seconds": time.process_time() - began, "status": found.status, "action": found.advice.action}
    labels = {(c.kind, c.place): {c.label, *c.same_as} for c in found.changes}
    named = [
        key for key, said in labels.items() if right and (key == right or WORDS[right[0]].format(right[1]) in said)
    ]
    out["named"] = bool(named) if right else not found.changes and found.status == "unchanged"
    out |= {"first": right in labels if right else None, "others": len(labels) > len(named)}
    out |= {"same_as": [len(c.same_as) for c in found.changes], "changes": [list(key) for key in labels]}
    if about["full"] and found.repaired is not None:
        fresh = place.measure(place.postures(rng, FRESH), rng)
        again = place.calibrated(place.measure(place.postures(rng), rng), points).calibration
        sizes = {}
        for name, model in (("repaired", found.repaired), ("full", again)):
            p = model.predict(fresh.q)[:, :3, 3]
            claimed = claim_at_tool(model, samples, Cell(), fresh.q, frozen="whole").mm["rms"].value
            sizes[name] = distance(p, fresh.p), distance(p, fresh.exact), claimed
            out |= dict(zip((f"{name}_mm", f"{name}_true_mm", f"{name}_expected_mm"), sizes[name], strict=True))
        out["ratio"] = [a / b if a and b else None for a, b in zip(sizes["repaired"], sizes["full"], strict=True)]
    return out


def months(task: harness.Task) -> harness.Result:
    """A gear's wave calibrated five times a month apart, set up again each time; in every second cell it grows."""
    place, rng = drawn(task["robot"], 3 * task["seed"])
    joint, cycles, phase = int(rng.integers(1, 4)), int(rng.integers(1, 120)), rng.uniform(0, 2 * np.pi)
    growth, wave = GROWTH * (task["number"] % 2 == 0), at_joint(joint, lambda q: np.sin(cycles * q + phase))
    with harness.scratch() as folder:
        for month in range(MONTHS):
            place.faults, when = (wave(AMPLITUDE * (1.0 + growth * month)),), BEGIN + month * MONTH
            q, way = place.postures(rng, EACH_MONTH), rng.normal(0.0, 0.1, 3)
            place.cell.tracker = place.cell.tracker[0] + way, place.cell.tracker[1] * Rotation.from_rotvec(way)
            found = place.calibrated(place.measure(q, rng), begin=when.timestamp())
            found.save(folder / f"{when:%Y-%m-%d}", page=False)
        (history,) = read_history(folder)
    own = next((s for s in history.series if s.name == f"curve of {place.cell.arm.names[joint]}"), None)
    trends = [s for s in history.series if s.trend is not None]
    true = 1e3 * AMPLITUDE / np.sqrt(2.0) * growth * (MONTHS - 1)  # of the RMS of a wave over whole turns, nearly
    seen = bool(growth) and own in trends
    out: harness.Result = {"grows": bool(growth), "cycles": cycles, "true_mrad": true, "named": seen}
    out |= {"covered": seen and bool(own.trend.low <= true <= own.trend.high), "said": [s.sentence for s in trends]}
    return {**out, "false": sum(s is not own or not growth for s in trends)}


def real(task: harness.Task) -> harness.Result:
    """What was said of the UR10's series, by kind of check, in words, and how often."""
    with harness.scratch() as folder:
        robot, a = recorded.series("a", folder)
        d = replace(recorded.series("d", folder)[1], frames=a.frames)
        some = np.sort(np.random.default_rng(0).choice(len(a), CALIBRATED, replace=False))
        modcal.calibrate(robot, a.select(some), seed=0).save(folder / "kept", page=False)
        calibration, share = Calibration.load(folder / "kept"), harness.report_of(folder / "kept")["predictable"]
    pattern = pattern_of(None if share is None else share["share"])
    rest, few = a.select(np.setdiff1d(np.arange(len(a)), some)), max(task["each"] // 5, 1)
    rng = np.random.default_rng([task["seed"], 26])

    def ten(samples: Samples, neighbours: bool) -> Samples:
        if neighbours:
            return samples.select(int(rng.integers(len(samples) - TEN)) + np.arange(TEN))
        return samples.select(np.sort(rng.choice(len(samples), TEN, replace=False)))

    def words(samples: Samples, label: str = "") -> str:
        try:
            found = modcal.check(calibration, samples, pattern=pattern)
        except ModcalError as error:
            return f"refused: {str(error)[:100]}"
        names = [(c.label, *c.same_as) for c in found.changes]
        right = "right, " if any(label in some for some in names) else "another, " if label and names else ""
        return right + found.status + (": " + " + ".join(" | ".join(some) for some in names) if names else "")

    cells = [(NOTHING, task["each"]), ("base", few), ("tool", few), ("joint_zero", few)]
    cells = [(n, *cell) for n in (False, True) for cell in cells] + [(n, "another day", few) for n in (False, True)]
    rows = []
    for neighbours, kind, count in cells:
        for _ in range(count):
            samples, label = ten(d if kind == "another day" else rest, neighbours), ""
            if kind in ("base", "tool", "joint_zero"):
                samples, label = moved(calibration, samples, kind, rng)
            rows.append((kind, "neighbours" if neighbours else "random", words(samples, label)))
    return {"pattern": pattern, "rows": [[*key, n] for key, n in Counter(rows).most_common()]}


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
    return replace(samples, reading=new[:, :3, 3], R=new[:, :3, :3]), WORDS[kind].format(chain.names[joint])


def ratios(k: int) -> Any:
    """A column: median and largest of repaired over full."""
    return over(lambda c: c["ratio"][k] if "ratio" in c else None, lambda v: f"{np.median(v):.2f}, {max(v):.2f}")


PERCENT = lambda hits: f"{np.mean(hits):.1%}"  # noqa: E731
COLUMNS = {
    "named or same_as": over("named", PERCENT),
    "95 %": over("named", lambda hits: "{:.1%} … {:.1%}".format(*harness.interval(sum(hits), len(hits)))),
    "first": over("first", PERCENT),
    "something else": over("others", PERCENT),
    "same_as, mean": over("same_as", lambda found: float(np.mean([n for each in found for n in each] or [np.nan]))),
    **{name: ratios(k) for k, name in enumerate(("repaired ÷ full, worst", "÷ full, truth", "by claims"))},
    "s": over("seconds", harness.median),
}


PARTS = {**dict.fromkeys(SETUPS, cell), "months": months, "real": real, "remounted": remounted.cell}


def main() -> int:
    given = harness.options(__doc__, seeds=12, names=PARTS, each=5, nothing=25, full=1, real_each=150)
    told = harness.told(given, "each", "nothing", "full")
    tasks = [
        {"part": part, "robot": ARMS[k % 3], "seed": given.first + k, "number": k, **told, **read}
        for k in range(given.seeds)
        for part in given.names
        if part != "real"
        for read in ([{"read": "points"}, {"read": "poses"}] if part == "remounted" else [{}])
    ]
    if "real" in given.names:
        harness.data()
        tasks.append({"part": "real", "seed": given.first, "each": given.real_each})
    results = harness.each(PARTS, tasks, given)
    for part, own in harness.grouped(results, "part").items():
        if part in SETUPS:
            harness.summary(part, [check for r in own for check in r["checks"]], "kind", COLUMNS)
        elif part == "remounted":
            checks = [check for r in own for check in r["checks"]]
            harness.summary(part, checks, ("read", "kind", "stations"), remounted.COLUMNS, sums=True)
        elif part == "real":
            harness.table("Real readings", ("what", "ten stations", "said", "checks"), own[0]["rows"])
        else:
            columns = {"growth named": over("named", harness.share), "and covered": over("covered", harness.share)}
            harness.summary("months", own, "grows", columns | {"false trends": over("false", sum)})
    return harness.ended(results)


if __name__ == "__main__":
    sys.exit(main())

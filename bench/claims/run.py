"""Claims at the tool against the truth, for every way in.

    python bench/claims/run.py --seeds 8 [--first 0] [--only contacts sockets] [--json FILE] [--jobs 1]

Each seed draws an arm, what is wrong with its links, an effect, noise and the number of stations, and writes tables,
an import mapping and a cell file, which ``modcal import`` and ``modcal calibrate`` read. The truth is the error of the
tool at 500 fresh postures inside the recorded ranges, joints not repeating as in the recording, against what
``Calibration.load(…).predict`` says; base frames are put where they fit best for instruments that cannot know them. A
tolerance of ½ to 4 times the truth is drawn before the run (the factor; the command gets a wide one, and PASS at the
drawn one is what it says of that: nothing else is open, and the upper end is within).
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import harness  # isort: skip

import numpy as np
from arm import EFFECTS, LINKS, OUTSIDE, Array, World, approaches, delta, pose, serial
from camera import Camera
from ways import CAMERA, MOST, WAYS, Recording, Site

ARMS = {"ur10": "tool0", "panda": "panda_link8", "xarm7": "link_eef", "iiwa14": "iiwa_link_ee"}
ROBOTS = harness.ROOT / "examples" / "robots"
FRESH = 500
WIDE_MM = 1000.0


def drawn(way: str, seed: int) -> tuple[dict[str, object], Site]:
    """What this cell is, by name; and the site."""
    rng = np.random.default_rng([seed, list(WAYS).index(way)])
    fewest = WAYS[way][1]
    arm_name = "delta" if way.startswith("delta") else str(rng.choice(list(ARMS)))
    links, effect = str(rng.choice(LINKS)), str(rng.choice(EFFECTS, p=[0.3, 0.13, 0.13, 0.08, *[0.12] * 3]))
    count = int(np.exp(rng.uniform(np.log(fewest), np.log(MOST))))
    arm = delta() if arm_name == "delta" else serial(ROBOTS / f"{arm_name}.urdf", ARMS[arm_name])
    if effect == "backlash" and way.startswith(("contacts", "sockets")):
        effect = "kink"  # these are reached from anywhere
    if effect == "compliance" and arm_name == "delta":
        effect = "gear"
    tool = (
        pose([0.06, -0.04, -0.1], np.zeros(3))
        if arm_name == "delta"
        else pose(rng.normal(0.0, 0.06, 3) + [0.0, 0.0, 0.1], rng.normal(0.0, 0.5, 3))
    )
    sizes = np.r_[rng.integers(7), rng.uniform(0.0, 3.0), np.exp(rng.normal(0.0, 0.5))]
    world = World(
        arm, arm.wrong(links, rng), tool, effect, sizes, float(np.exp(rng.uniform(np.log(5e-6), np.log(4e-5))))
    )
    factor = float(np.exp(rng.uniform(np.log(0.5), np.log(4.0))))
    what = {"arm": arm_name, "links": links, "effect": effect, "stations": count, "factor": factor}
    return what, Site(world, rng, count)


def fresh(site: Site, low: Array, high: Array) -> tuple[Array, Array]:
    """Postures (FRESH, n) inside these ranges, and the tool's true poses there."""
    new = site.rng.uniform(low, high, (20 * FRESH, len(low)))
    new = new[np.isfinite(site.world.built.tips(new)).all(axis=(1, 2))][:FRESH]
    return new, site.at(new)


def missed(T: Array, truth: Array, recording: Recording) -> Array:
    """Distances (N,) [mm] between predicted and true tools, bases as they suit best where no instrument knows them; the
    tool's point, too, where none shows it.
    """
    a, b = T[:, :3, 3], truth[:, :3, 3]
    if recording.direct is not None:
        return np.asarray(1e3 * np.linalg.norm(a - (b @ recording.direct[:3, :3].T + recording.direct[:3, 3]), axis=1))
    for _ in range(1 if recording.shows_tool else 100):
        x, y = a - a.mean(axis=0), b - b.mean(axis=0)
        U, _, V = np.linalg.svd(x.T @ y)
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V
        gap = x @ R - y
        if not recording.shows_tool:
            M = np.concatenate([R.T @ T[:, :3, :3], np.broadcast_to(np.eye(3), (len(a), 3, 3))], axis=2).reshape(-1, 6)
            a = a - T[:, :3, :3] @ np.linalg.lstsq(M, gap.ravel(), rcond=1e-9)[0][:3]
    return np.asarray(1e3 * np.linalg.norm(gap, axis=1))


def predicted(calibration: object, q: Array, frame: str) -> tuple[Array, Array]:
    """Tools (N, 4, 4) by the calibrated and by the nominal arm, at postures gone through in this order."""
    from modcal import Samples

    asked = Samples.from_arrays(q, points=np.zeros((len(q), 3)), names=calibration.nominal.chain.names, frame=frame)  # type: ignore[attr-defined]
    asked = replace(asked, approach=approaches(q))
    nominal = replace(calibration, calibrated=replace(calibration.nominal, effects=()))  # type: ignore[attr-defined,type-var]
    return calibration.predict(asked), nominal.predict(q, frame)  # type: ignore[attr-defined]


def one(task: harness.Task) -> harness.Result:
    """What came of one cell."""
    what, site = drawn(task["way"], task["seed"])
    return by_camera(what, site) if task["way"] == CAMERA else by_tables(what, site, WAYS[task["way"]][0](site))


def calibrated(what: dict[str, object], folder: Path, *options: object) -> tuple[harness.Result, object]:
    """The report and the calibration, or what was said and none."""
    from modcal import Calibration

    arm = str(what["arm"])
    robot = ["--delta", ROBOTS / "delta.yaml"] if arm == "delta" else ["--tip", ARMS[arm]]
    code, said = harness.modcal("calibrate", *options, *robot, "--tolerance-mm", WIDE_MM, "--out", folder / "out")
    if code not in (0, 3):
        return {**what, "outcome": "refused" if code == 2 else "broke", "said": said.strip()[-300:]}, None
    return harness.report_of(folder / "out"), Calibration.load(folder / "out")


def by_tables(what: dict[str, object], site: Site, recording: Recording) -> harness.Result:
    """The same of readings in tables, whose claim is the 95th percentile over the recorded ranges."""
    what["stations"] = len(recording.q)
    with harness.scratch() as folder:
        recording.write(
            folder, site.world.drawn.names, ROBOTS / f"{what['arm']}.urdf" if what["arm"] != "delta" else None
        )
        harness.succeeded("import", folder / "m.yaml", "--data", folder, "--out", folder / "bag")
        report, calibration = calibrated(what, folder, folder / "bag", "--cell", folder / "cell.yaml")
    if calibration is None:
        return report
    ends = (recording.q.min(axis=0), recording.q.max(axis=0)), (site.world.drawn.low, site.world.drawn.high)
    there = [fresh(site, *each) for each in ends]
    inside, whole = ([missed(T, at, recording) for T in predicted(calibration, q, recording.frame)] for q, at in there)
    true, nominal = (float(np.percentile(e, 95)) for e in inside)
    worse = {"worse_whole": bool(np.sqrt((whole[0] ** 2).mean()) > np.sqrt((whole[1] ** 2).mean()))}
    worse["within"] = report.get("apply_within") is not None
    claim = report.get("claim_mm")
    most = report["tolerance"]["ci95"][1] if claim is None else claim["p95"]["ci95"][1]
    told = "no reading" if claim and claim["unshown_mm"] > 0.5 * most else "readings"
    found = {"apply": report.get("apply"), **worse, "claim": claim, "most of it by": told}
    return {**judged(what, report, true, nominal, most), **found}


def by_camera(what: dict[str, object], site: Site) -> harness.Result:
    """The same of a camera, whose claim is the RMS where the board is in view."""
    camera = Camera(site)
    with harness.scratch() as folder:
        q = camera.record(folder)
        what["stations"] = len(q)
        files = {"images": "corners.csv", "joints": "joints.csv", "target": "target.yaml"}
        options = [x for name, file in files.items() for x in (f"--{name}", folder / file)]
        report, calibration = calibrated(what, folder, *options, "--urdf", ROBOTS / f"{what['arm']}.urdf")
    if calibration is None:
        return report
    new = camera.postures(FRESH, q.min(axis=0), q.max(axis=0))
    truth, errors = np.linalg.inv(camera.board) @ site.at(new), []
    for model in (calibration.calibrated, calibration.nominal):  # type: ignore[attr-defined]
        T = replace(calibration, calibrated=model).predict(new, model.frames[0])  # type: ignore[type-var]
        flange = np.linalg.inv(model.T_tip_tool)[:, 3]  # a point of the camera: how the two hang together, none knows
        errors.append(1e3 * float(np.sqrt((((T - truth) @ flange)[:, :3] ** 2).sum(axis=1).mean())))
    apply = {"apply": True, "do not apply": False}.get(report["camera"]["decision"])
    most = report["camera"]["tool_error_mm"]["in_view"]["calibrated"]["high95"]
    return {**judged(what, report, *errors, most), "apply": apply, "worse_whole": False, "within": False}


def judged(
    what: dict[str, object], report: harness.Result, true: float, nominal: float, most: float | None
) -> harness.Result:
    """What was said against what is true."""
    limit, most = float(str(what["factor"])) * true, np.nan if most is None else most
    passed = report["tolerance"]["result"] == "PASS" and most <= limit
    out = {"true": true, "nominal": nominal, "most": most, "ratio": most / true, "covered": most >= true}
    out |= {"passed": passed, "false_pass": passed and limit < true, "worse": true > nominal}
    return {**what, **out, "outcome": "judged" if most > 0.0 else "no claim", "status": report["status"]}


COUNTS: dict[str, Callable[[harness.Result], bool]] = {
    "covered": lambda r: r["covered"],
    "PASS": lambda r: r["passed"],
    "false": lambda r: r["false_pass"],
    "worse": lambda r: r["worse"],
    "+ apply": lambda r: r["worse"] and r["apply"] is True,
    "needless": lambda r: r["apply"] is False and not r["worse"],
    "whole worse": lambda r: r["worse_whole"],
    "+ anywhere": lambda r: r["worse_whole"] and r["apply"] is True and not r["within"],
}


def rows(results: list[harness.Result], by: str) -> None:
    """One line a group."""
    out: list[list[object] | None] = []
    for group in [*dict.fromkeys(r.get(by) for r in results), None]:
        here = [r for r in results if group is None or r.get(by) == group]
        made = [r for r in here if r["outcome"] == "judged"]
        ratio = np.array([r["ratio"] for r in made] or [np.nan])
        shares = [float(np.quantile(ratio, share)) for share in (0.5, 0.1, 0.9)]
        counts = [sum(bool(count(r)) for r in made) for count in COUNTS.values()]
        out += [None] if group is None else []
        out.append(["all" if group is None else group, len(here), len(made), *shares, *counts])
    harness.table(f"claims by {by}", [by, "cells", "claims", "claim/truth", "10 %", "90 %", *COUNTS], out)


def main() -> int:
    """Run the cells and print a table for each question."""
    given = harness.options(__doc__, seeds=4, names=WAYS, jobs=1)
    results = harness.each(one, harness.tasks(given, way=given.names), given, _line)
    failed, results = harness.failures(results), [r for r in results if not r["failed"]]
    for r in results:
        r["open"] = WAYS[r["way"]][2]
        r["kind"] = "none" if r.get("effect") == "none" else "outside" if r.get("effect") in OUTSIDE else "known"
    for by in ("way", "links", "kind", "open", "most of it by", "arm"):
        rows(results, by)
    harness.counts("outcomes", results, "way", "outcome")
    return failed


def _line(r: harness.Result) -> str:
    if "true" not in r:
        return f"{r['outcome']} {r.get('said', '')[-120:]}"
    most = f"{r['most']:.3f}"
    return (
        f"{r['arm']} {r['links']} {r['effect']} {r['stations']}: true {r['true']:.3f} nominal {r['nominal']:.3f} "
        f"claim {most} {'PASS' if r['passed'] else ''}{' FALSE' if r['false_pass'] else ''} apply {r['apply']}"
    )


if __name__ == "__main__":
    raise SystemExit(main())

"""Arms calibrated by cameras in simulated cells: true errors, intervals, advice, and what is named.

    make bench NAME=camera ARGS="--only arms --first 44 --seeds 80 --rendered --faults 1.5 --measured-to-mm 0.05"

arms: a board seen by a camera on the tip or in the world (--rendered: corners found in images that a ray tracer made;
--faults: of every arm, 1 for 4 mm and 5 mrad a body; --measured-to-mm: of the sheet's rulers). size: sheets --off by
2 % of what is stated (--read: at a length that nobody states who has not measured). named: late images, line time, a
print's size, a bow. moved: camera, target or joint moved while the robot works, within five images. bodies: fixed
cameras and a body of markers. speed: processor.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import harness

# isort: split
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cells
import cv2
import numpy as np
from camera.boards import BOARD, LENS
from camera.bodies import BODY_ON_TIP, BodyScene
from camera.by_tracker import missed_by_tracker
from camera.fits import problem
from camera.render import render
from camera.scenes import CameraScene, scene
from harness import median, over, share
from scipy.spatial.transform import Rotation

from modcal_core.camera.bundle import BoardView
from modcal_core.camera.changes import CameraWatch
from modcal_core.camera.corners import CornerTable
from modcal_core.camera.fit import CameraFit
from modcal_core.camera.mounting import first_lens, fit_lens
from modcal_core.camera.solve import CameraProblem, CameraSolution, solve_camera
from modcal_core.camera.target_file import RULER_STD_M
from modcal_core.camera.views import POSTURES, postures_in_view
from modcal_core.errors import ModcalError
from modcal_core.geometry import Array, se3
from modcal_core.robots import random_postures
from modcal_nodes.vision import detect

EXPECTED = {"delay": ("clock", "velocity", "all"), "line time": ("clock", "line", "all")}
EXPECTED |= {"scale": ("target", "constant", "size"), "bow": ("target", "constant", "normal")}
REFLECTOR = np.array([0.05, 0.03, 0.12])  # of a tracker, in the frame of the arm's last link
QUIET, BESIDE, FIVE, TWICE = 300, 8, 5, 2  # images without a change; before and after one; that may pass; each
DISPLACED, SHIFT_M, TURN_RAD = ((1e-3, 1.5e-3), (4e-3, 5e-3)), 2e-3, np.radians(0.2)
SEEDS = {"arms": 20, "named": 10, "size": 10, "moved": 8, "bodies": 12, "speed": 1}


def one(task: harness.Task) -> harness.Result:
    """What came of a cell, and what is true of it; ``refused`` where modcal would not take it."""
    try:
        return PART[task["part"]](task)
    except ModcalError as error:
        return {"refused": str(error)}


def solved(s: CameraScene, rng: np.random.Generator, **told: Any) -> CameraSolution:
    return solve_camera(problem(s, **told), rng)


def apart(a: Array, b: Array, turned: bool = False) -> float:
    """RMS distance [mm] of points (N, 3); turned: the frame of the first put where that is least."""
    if turned:
        a, b = a - a.mean(axis=0), b - b.mean(axis=0)
        a = Rotation.align_vectors(b, a)[0].apply(a)
    return 1e3 * harness.rms(np.linalg.norm(a - b, axis=1))


def said(r: CameraSolution) -> harness.Result:
    """The verdict, and values with 95 % intervals [mm] of the errors."""
    errors = {"said": r.claim.in_view, "alone_said": r.claim.alone, "anywhere_said": r.claim.anywhere}
    out = {key: [np.nan] * 3 if e is None else [1e3 * x for x in e.interval] for key, e in errors.items()}
    return {**out, "word": r.claim.decision.word, "because": list(r.claim.decision.because)}


def true_error(s: CameraScene, fit: CameraFit, tip: Array, q: Array, arm_alone: bool = False) -> float:
    """RMS distance of the flange from the truth [mm]."""
    T, _ = fit.poses.at_postures(q).tool_motions(fit.state.values)
    return apart(se3.apply(T, tip), se3.apply(s.truth(q), tip), arm_alone)


def arms(task: harness.Task) -> harness.Result:
    seed = task["seed"]
    s = cells.arm(seed, task["rendered"], task["faults"], 1e-3 * task["measured_to_mm"])
    began = time.process_time()
    r = solved(s, np.random.default_rng(seed))
    tip, near = r.fit.flange, postures_in_view(r.fit, np.random.default_rng(seed + 1))
    far = random_postures(s.chain, POSTURES, np.random.default_rng(seed + 1))
    z = (r.fit.state.lens.values - s.lens.values) / r.fit.std[0][r.fit.poses.count + 1 :][:9]
    out = {"opencv": against_opencv(s), "effects": [f"{c.effect.family} {c.effect.label}" for c in r.evidence.causes]}
    out |= {"seconds": time.process_time() - began, "images": len(s.views), "lens_sigmas": list(z)}
    out["mounted"] = s.on_tip == r.fit.poses.camera_on_tip
    out |= {"true": true_error(s, r.fit, tip, near), "nominal": true_error(s, r.nominal, tip, near)}
    out |= {"alone": true_error(s, r.fit, tip, near, arm_alone=True), "anywhere": true_error(s, r.fit, tip, far)}
    return {**out, **said(r), "found_of_camera": [f.sentence for f in r.evidence.findings]}


def against_opencv(s: CameraScene) -> float:
    """Relative difference of the least cost from that of calibrateCamera on the same corners, without a prior.

    Of a flat board whose size both take as it stands; its square is one that OpenCV's single precision holds exactly.
    """
    flat, white = replace(BOARD, square=0.03125, scale=s.board.scale), []
    for v in s.views:
        pixels = v.pixels.astype(np.float32).astype(float)
        white.append(BoardView(v.name, v.ids, pixels, np.tile(np.eye(2), (len(v), 1, 1))))
    table = CornerTable.of(white, flat)
    own = fit_lens(table, first_lens(table, s.lens.size))
    points = [flat.points[v.ids].astype(np.float32) for v in white]
    pixels = [v.pixels.astype(np.float32).reshape(-1, 1, 2) for v in white]
    end = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 500, 1e-15)
    rms = cv2.calibrateCamera(points, pixels, s.lens.size, None, None, flags=0, criteria=end)[0]
    return own.cost / (rms**2 * len(table)) - 1.0


def size(task: harness.Task) -> harness.Result:
    """A sheet that is off what is stated; if_wrong: the error said for a wrong statement [mm]."""
    s = cells.sheet(task["seed"], task["off"], 1.0 if task["faults"] is None else task["faults"], task["read"])
    r = solved(s, np.random.default_rng(3))
    q = postures_in_view(r.fit, np.random.default_rng(1))
    out = {"named": any("off its stated size" in words for words in r.claim.decision.problems), **said(r)}
    out |= {key: true_error(s, fit, fit.flange, q) for key, fit in (("true", r.fit), ("nominal", r.nominal))}
    return {**out, "if_wrong": None if r.claim.rests_on is None else 1e3 * r.claim.rests_on.if_wrong_m}


def named(task: harness.Task) -> harness.Result:
    """Target and camera: what is named, and what else is blamed."""
    s, told = cells.faulty(task["seed"], task["kind"])
    r = solved(s, np.random.default_rng(task["seed"]), **told)
    right = [(f.family, f.entry.driver, f.entry.direction) == EXPECTED.get(task["kind"]) for f in r.evidence.findings]
    blamed = [f.sentence for f, good in zip(r.evidence.findings, right, strict=True) if not good]
    found = any(right) if task["kind"] in EXPECTED else None
    return {"named": found, "blamed": blamed, "effects": [c.effect.label for c in r.evidence.causes]}


def moved(task: harness.Task) -> harness.Result:
    """Of each change: seen, rightly named, and nothing else; and of quiet images the alarms."""
    seed, on_tip = task["seed"], bool(task["seed"] % 2)
    s = scene(9000 + seed, on_tip, 25, *DISPLACED[seed // 2 % 2], board=cells.MEASURED)
    rng = np.random.default_rng(seed)
    fit = solved(s, rng, look_for_effects=False).fit
    watch = CameraWatch(fit, s.board)
    quiet = [watch.image(v, q) is not None for q, v in cells.images(s, rng, QUIET)]
    alarms = sum(now and not before for before, now in zip([False, *quiet], quiet, strict=False))
    rows: list[harness.Result] = [{"change": "nothing", "images": len(quiet), "alarms": alarms}]

    def along(much: float) -> Array:
        direction = rng.normal(size=3)
        return much * direction / np.linalg.norm(direction)

    for _ in range(TWICE):
        joint = int(rng.integers(1, 6))
        twists = {"2 mm": np.r_[along(SHIFT_M), 0.0, 0.0, 0.0], "0.2°": np.r_[0.0, 0.0, 0.0, along(TURN_RAD)]}
        halves = (("world", "target" if on_tip else "camera"), ("tip", "camera" if on_tip else "target"))
        cases = [
            (f"{what} on the {where}, {much}", what, cells.images(s, rng, BESIDE, **{where: twist}))
            for where, what in halves
            for much, twist in twists.items()
        ]
        slipped = cells.images(s, rng, BESIDE, joint=joint, slip=TURN_RAD)
        for name, what, after in [*cases, ("joint, 0.2°", f"joint {s.chain.names[joint]}", slipped)]:
            watch = CameraWatch(fit, s.board)
            for q, v in cells.images(s, rng, BESIDE):
                watch.image(v, q)
            names = [seen.what for q, v in after[:FIVE] if (seen := watch.image(v, q)) is not None][-1:]
            among = what in " or ".join(names).split(" or ")
            rows.append({"change": name, "seen": bool(names), "named": among, "alone": names == [what]})
    return {"rows": rows}


def bodies(task: harness.Task) -> harness.Result:
    s, what = cells.body(task["seed"])
    began = time.process_time()
    rng = np.random.default_rng(task["seed"])
    r = solve_camera(CameraProblem(s.chain, s.images), rng)
    spent, q = time.process_time() - began, postures_in_view(r.fit, np.random.default_rng(1))
    out = {**what, "seconds": spent, **said(r), "px": list(r.claim.held_out_px)}
    for name, fit in (("", r.fit), ("nominal_", r.nominal)):
        out |= {name + key: value for key, value in of_body(s, fit, r.fit.flange, q).items()}
    out["effects"], out["findings"] = (
        [c.effect.label for c in r.evidence.causes],
        [f"{f.family} {f.entry.direction}" for f in r.evidence.findings],
    )
    return {**out, "out": len(r.camera.left_out), "corners_out": r.fit.table.left_out}


def of_body(s: BodyScene, fit: CameraFit, point: Array, q: Array) -> dict[str, float]:
    """RMS [mm] of the flange in the first camera's frame, with that frame put where it is least, and by a tracker."""
    T = fit.poses.at_postures(q).tool_at(fit.state.values)
    true = se3.inverse(s.cameras[0]) @ s.tip(q) @ BODY_ON_TIP @ s.true_body()
    a, b = se3.apply(T, point), se3.apply(true, point)
    return {"true": apart(a, b), "alone": apart(a, b, True), "tracker": 1e3 * missed_by_tracker(T, s.tip(q), REFLECTOR)}


def speed(task: harness.Task) -> harness.Result:
    """Thirty images of 1280 × 720 with a ChArUco board of 7 × 5 squares: seconds of processor."""
    s = scene(5, True, count=30, board=cells.MEASURED)
    rng = np.random.default_rng(0)
    pictures = [render(T, LENS, BOARD, rng) for T in se3.inverse(s.T)]
    detect(pictures[0], cells.MEASURED, "warm")
    began = time.process_time()
    views = [detect(picture, cells.MEASURED, f"{i}.png").view for i, picture in enumerate(pictures)]
    detected = time.process_time() - began
    keep = [i for i, view in enumerate(views) if view is not None]
    began = time.process_time()
    r = solved(replace(s, q=s.q[keep], views=[views[i] for i in keep]), rng)
    out = {"images": len(pictures), "with target": len(keep), "corners": int(r.fit.table.weight.sum())}
    return {**out, "detection_s": detected, "fit_s": time.process_time() - began, "word": r.claim.decision.word}


PART = {"arms": arms, "named": named, "size": size, "moved": moved, "bodies": bodies, "speed": speed}
Column = Callable[[list[harness.Result]], Any]


def inside(true: str, words: str, below: bool = False) -> Column:
    """A column: whether a true error is in what was said of it, or below its upper end."""
    return over(lambda r: (below or r[words][1] <= r[true]) and r[true] <= r[words][2], share)


def where(which: Callable[[harness.Result], bool], column: Column) -> Column:
    return lambda results: column([r for r in results if which(r)])


def applied(r: harness.Result) -> bool:
    return r["word"] == "apply"


def errors(error: str, nominal: str) -> dict[str, Column]:
    out: dict[str, Column] = {f"{key}, median": over(key, median) for key in (error, nominal, "alone", "seconds")}
    for true, words in (("true", "said"), ("alone", "alone_said")):
        out[f"{true} in its interval"], out[f"{true} below"] = inside(true, words), inside(true, words, True)
        out[f"upper end over {true}, median"] = over(lambda r, t=true, w=words: r[w][2] / r[t], median)
    out["apply, and worse than nominal"] = where(applied, over(lambda r: r[error] >= r[nominal], share))
    out["below half of nominal, and apply"] = where(lambda r: r[error] < 0.5 * r[nominal], over(applied, share))
    return out


ARMS: dict[str, Column] = {
    "anywhere below": inside("anywhere", "anywhere_said", True),
    "at most 1 mm": over(lambda r: r["true"] <= 1.0, share),
    "mounting told": over("mounted", share),
    "intrinsics within 3 sigma": over("lens_sigmas", lambda z: f"{np.mean(np.abs(np.concatenate(z)) <= 3.0):.1%}"),
    "cost over OpenCV's, less one": over("opencv", lambda v: f"{np.abs(v).max():.1e} at most"),
    "cells with an effect": over(lambda r: bool(r["effects"]), share),
}
BODIES = {
    "gear of joint 2 found": where(
        lambda r: r["periodic"], over(lambda r: any("joint2" in e for e in r["effects"]), share)
    ),
    "blamed without one": where(lambda r: not r["periodic"], over(lambda r: bool(r["effects"]), share)),
}
SIZE = {
    "named": over("named", sum),
    "cannot tell": over(lambda r: r["word"] == "cannot tell", sum),
    "apply": over(applied, sum),
    "and worse": where(applied, over(lambda r: r["true"] >= r["nominal"], sum)),
    "error said if wrong holds": where(
        applied, over(lambda r: None if r["if_wrong"] is None else r["true"] <= r["if_wrong"], sum)
    ),
    "in its interval": inside("true", "said"),
    "half of nominal, and apply": where(lambda r: r["true"] < 0.5 * r["nominal"], over(applied, share)),
}
NAMED = {"named": over("named", share), "something else of target or camera": over(lambda r: bool(r["blamed"]), share)}
NAMED["of the arm"] = over(lambda r: bool(r["effects"]), share)
MOVED = {f"within {FIVE} images": over("seen", share), "rightly named": over("named", share)}
MOVED |= {"nothing else": over("alone", share), "images": over("images", sum), "false alarms": over("alarms", sum)}


def show(part: str, good: list[harness.Result]) -> None:
    if part in ("arms", "bodies"):
        error, nominal = ("true", "nominal") if part == "arms" else ("tracker", "nominal_tracker")
        own = ("images",) if part == "arms" else ("arm", "cameras", "postures", "true")
        harness.rows("Errors, mm", good, ("seed", *own, nominal, error, "alone", "word", "said", "alone_said"))
        says = errors(error, nominal) | (ARMS if part == "arms" else BODIES)
        harness.table(part, ("", ""), [(name, column(good)) for name, column in says.items()])
    elif part == "moved":
        harness.summary(part, [row for r in good for row in r["rows"]], "change", MOVED)
    elif part == "speed":
        harness.rows(part, good, [key for key in good[0] if key not in ("part", "seed", "cpu_s", "s", "failed")])
    else:
        harness.summary(part, good, *(("off", SIZE) if part == "size" else ("kind", NAMED)))


def main() -> int:
    given = harness.options(
        __doc__,
        **{"seeds": None, "names": SEEDS, "rendered": False, "faults": float, "measured_to_mm": 1e3 * RULER_STD_M},
        **{"off": [-0.02, 0.02], "read": False},
    )
    told = {"arms": ("rendered", "faults", "measured_to_mm"), "size": ("faults", "read")}
    rows = {"size": [{"off": off} for off in given.off], "named": [{"kind": kind} for kind in cells.KINDS]}
    tasks = [
        {**task, **more, **harness.told(given, *told.get(task["part"], ()))}
        for task in harness.tasks(given, SEEDS, part=given.names)
        for more in rows.get(task["part"], [{}])
    ]
    results = harness.each(one, tasks, given, lambda r: r.get("refused", r.get("word", "")))
    for part, own in harness.grouped(results, "part").items():
        if good := [r for r in own if "refused" not in r]:
            show(part, good)
        refused = [f"  {r['seed']}: {r['refused']}" for r in own if "refused" in r]
        harness.say(f"{part}: {len(refused)} refused", *refused)
    return harness.ended(results)


if __name__ == "__main__":
    sys.exit(main())

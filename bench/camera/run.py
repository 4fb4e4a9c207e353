"""Arms calibrated by cameras in simulated cells: true errors, intervals, advice, and what is named.

    make bench NAME=camera ARGS="--only arms --first 44 --seeds 80 --rendered --faults 1.5 --measured-to-mm 0.05"

arms: a board seen by a camera on the tip or in the world. size: sheets 2 % off what is stated (``--read``: at a length
that nobody states who has not measured). named: late images, line time, a print's size, a bow. moved: camera, target or
joint moved while the robot works, within five images. bodies: fixed cameras and a body of markers. speed: processor.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import harness

# isort: split
import time
from dataclasses import replace
from typing import Any

import cells
import cv2
import numpy as np
from camera.boards import BOARD, LENS
from camera.bodies import BODY_ON_TIP, BodyScene
from camera.by_tracker import missed_by_tracker
from camera.render import render
from camera.scenes import CameraScene, scene

from modcal_core.camera.bundle import BoardView
from modcal_core.camera.causes import flange_in_tool
from modcal_core.camera.corners import CornerTable
from modcal_core.camera.fit import CameraFit
from modcal_core.camera.intrinsics import first_lens, fit_lens
from modcal_core.camera.solve import CameraSolution, solve_camera
from modcal_core.camera.target_file import RULER_STD_M
from modcal_core.camera.tool_error import postures_anywhere, postures_in_view
from modcal_core.camera.watching import CameraWatch
from modcal_core.errors import ModcalError
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_nodes.vision.detection import detect

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
    return solve_camera(s.chain, s.q, s.views, s.board, s.lens.size, rng, **told)


def apart(a: Array, b: Array, turned: bool = False) -> float:
    """RMS distance [mm] of points (N, 3); turned: the frame of the first put where that is least."""
    if turned:
        a, b = a - a.mean(axis=0), b - b.mean(axis=0)
        U, _, Vt = np.linalg.svd(a.T @ b)
        a = a @ U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return 1e3 * harness.rms(np.linalg.norm(a - b, axis=1))


def millimetres(error: Any) -> list[float]:
    """Value and 95 % interval."""
    return [np.nan] * 3 if error is None else [1e3 * x for x in error.interval]


def true_error(s: CameraScene, fit: CameraFit, tip: Array, q: Array, arm_alone: bool = False) -> float:
    """RMS distance of the flange from the truth [mm]."""
    T, _ = fit.poses.at_postures(q).tool_motions(fit.state.values)
    return apart(se3.apply(T, tip), se3.apply(s.truth(q), tip), arm_alone)


def flange(fit: CameraFit) -> Array:
    """The flange in the frame of the tool."""
    return se3.inverse(fit.poses.model_at(fit.state.values).T_tip_tool)[:3, 3]


def arms(task: harness.Task) -> harness.Result:
    """An arm calibrated by a board."""
    seed = task["seed"]
    s = cells.arm(seed, task["rendered"], task["faults"], 1e-3 * task["measured_to_mm"])
    began = time.process_time()
    r = solved(s, np.random.default_rng(seed))
    tip, (near, _) = flange(r.fit), postures_in_view(r.fit, np.random.default_rng(seed + 1))
    far = postures_anywhere(s.chain, np.random.default_rng(seed + 1))
    z = (r.fit.state.lens.values - s.lens.values) / np.sqrt(np.diag(r.fit.covariance))[r.fit.poses.count + 1 :][:9]
    out = {"opencv": against_opencv(s), "effects": [f"{c.effect.family} {c.effect.label}" for c in r.causes]}
    out |= {"seconds": time.process_time() - began, "images": len(s.views), "lens_sigmas": list(z)}
    out |= {"mounting": "tip" if s.on_tip else "world", "found": "tip" if r.fit.poses.camera_on_tip else "world"}
    out |= {"true": true_error(s, r.fit, tip, near), "nominal": true_error(s, r.nominal, tip, near)}
    out |= {"alone": true_error(s, r.fit, tip, near, arm_alone=True), "anywhere": true_error(s, r.fit, tip, far)}
    out |= {"said": millimetres(r.in_view), "alone_said": millimetres(r.alone)}
    out |= {"anywhere_said": millimetres(r.anywhere), "found_of_camera": [f.sentence for f in r.findings]}
    return {**out, "word": r.decision.word, "because": list(r.decision.because)}


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
    """A sheet that is off what is stated."""
    s = cells.sheet(task["seed"], task["off"], 1.0 if task["faults"] is None else task["faults"], task["read"])
    r = solved(s, np.random.default_rng(3))
    q, _ = postures_in_view(r.fit, np.random.default_rng(1))
    rests = r.rests_on
    out = {"word": r.decision.word, "named": any("off its stated size" in said for said in r.decision.problems)}
    out |= {"said": millimetres(r.in_view), "true": true_error(s, r.fit, flange(r.fit), q)}
    out |= {"nominal": true_error(s, r.nominal, flange(r.nominal), q)}
    return {**out, "if_wrong": None if rests is None else 1e3 * rests.if_wrong_m}


def named(task: harness.Task) -> harness.Result:
    """Target and camera: what is named, and what else is blamed."""
    s, told = cells.faulty(task["seed"], task["kind"])
    r = solved(s, np.random.default_rng(task["seed"]), **told)
    right = [(f.family, f.driver, f.direction) == EXPECTED.get(task["kind"]) for f in r.findings]
    blamed = [f.sentence for f, good in zip(r.findings, right, strict=True) if not good]
    return {"named": any(right), "blamed": blamed, "effects": [c.effect.label for c in r.causes]}


def moved(task: harness.Task) -> harness.Result:
    """[name of the change, seen, rightly named, and nothing else] of each change; and of quiet images the alarms."""
    seed, on_tip = task["seed"], bool(task["seed"] % 2)
    length, angle = DISPLACED[seed // 2 % 2]
    s = scene(9000 + seed, on_tip, count=25, length_std=length, angle_std=angle, board=cells.MEASURED)
    rng = np.random.default_rng(seed)
    fit = solved(s, rng, look_for_effects=False).fit
    watch = CameraWatch(fit, s.board)
    said = [watch.image(v, q) is not None for q, v in cells.images(s, rng, QUIET)]
    out: dict[str, Any] = {"quiet": len(said), "changes": []}
    out["alarms"] = sum(now and not before for before, now in zip([False, *said], said, strict=False))

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
            names = [seen.what for q, v in after[:FIVE] if (seen := watch.image(v, q)) is not None]
            out["changes"].append(
                [name, bool(names), what in " or ".join(names[-1:]).split(" or "), names[-1:] == [what]]
            )
    return out


def bodies(task: harness.Task) -> harness.Result:
    """Fixed cameras and a body of markers."""
    s, what = cells.body(task["seed"])
    first, *others = s.images
    began = time.process_time()
    rng = np.random.default_rng(task["seed"])
    r = solve_camera(s.chain, first.q, first.views, first.target, first.size, rng, further=others)
    spent, (q, _) = time.process_time() - began, postures_in_view(r.fit, np.random.default_rng(1))
    out = {**what, "seconds": spent, "word": r.decision.word, "because": r.decision.because[0]}
    out |= {"said": millimetres(r.in_view), "alone_said": millimetres(r.alone), "px": list(r.held_out_px)}
    for name, fit in (("", r.fit), ("nominal_", r.nominal)):
        out |= {name + key: value for key, value in of_body(s, fit, flange_in_tool(r.fit), q).items()}
    out |= {
        "effects": [c.effect.label for c in r.causes],
        "findings": [f"{f.family} {f.direction}" for f in r.findings],
    }
    return {**out, "out": len(r.left_out), "corners_out": r.corners_out}


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
    return {**out, "detection_s": detected, "fit_s": time.process_time() - began, "word": r.decision.word}


PART = {"arms": arms, "named": named, "size": size, "moved": moved, "bodies": bodies, "speed": speed}


def inside(cell: harness.Result, true: str, said: str, below: bool = False) -> bool:
    """Whether a true error is in what was said of it, or below its upper end."""
    return (below or cell[said][1] <= cell[true]) and cell[true] <= cell[said][2]


def show(part: str, good: list[harness.Result]) -> None:
    """What the cells of a part come to."""
    share = harness.share
    if part in ("arms", "bodies"):
        error, nominal, own = "true", "nominal", ("images",)
        if part == "bodies":
            error, nominal, own = "tracker", "nominal_tracker", ("arm", "cameras", "postures", "true")
        keys, pairs = ("seed", *own, nominal, error, "alone", "word"), (("true", "said"), ("alone", "alone_said"))
        rows = [[*(r[k] for k in keys), *("{:.2f} ({:.2f} to {:.2f})".format(*r[s]) for _, s in pairs)] for r in good]
        harness.table("Errors, mm", (*keys, "said, 95 %", "said of the arm alone"), rows)
        says = {f"{t} inside its interval": share(inside(r, t, s) for r in good) for t, s in pairs}
        says |= {f"{t} below its upper end": share(inside(r, t, s, True) for r in good) for t, s in pairs}
        says |= {f"upper end over {t}, median": f"{np.median([r[s][2] / r[t] for r in good]):.2f}" for t, s in pairs}
        says["apply, and worse than nominal"] = share(r[error] >= r[nominal] for r in good if r["word"] == "apply")
        halved = [r["word"] == "apply" for r in good if r[error] < 0.5 * r[nominal]]
        says["below half of nominal, and apply"] = share(halved)
        says |= {f"{k}, median": f"{np.median([r[k] for r in good]):.2f}" for k in (error, nominal, "alone", "seconds")}
    if part == "arms":
        sigmas = np.abs(np.concatenate([r["lens_sigmas"] for r in good]))
        says["anywhere below"] = share(inside(r, "anywhere", "anywhere_said", True) for r in good)
        says["at most 1 mm"] = share(r["true"] <= 1.0 for r in good)
        says["mounting told"] = share(r["mounting"] == r["found"] for r in good)
        says["intrinsics within 3 sigma"] = f"{np.mean(sigmas <= 3.0):.1%} of {len(sigmas)}"
        says["cost over OpenCV's, less one"] = f"{np.abs([r['opencv'] for r in good]).max():.1e} at most"
        says["cells with an effect"] = share(bool(r["effects"]) for r in good)
    elif part == "bodies":
        says["gear of joint 2 found"] = share(any("joint2" in e for e in r["effects"]) for r in good if r["periodic"])
        says["blamed without one"] = share(bool(r["effects"]) for r in good if not r["periodic"])
    elif part == "size":
        says = {}
        for off in dict.fromkeys(r["off"] for r in good):
            of = [r for r in good if r["off"] == off]
            apply = [r for r in of if r["word"] == "apply"]
            warned = [r["true"] <= r["if_wrong"] for r in apply if r["if_wrong"] is not None]
            halved = share(r["word"] == "apply" for r in of if r["true"] < 0.5 * r["nominal"])
            says[f"{off:+.0%}"] = (
                f"named {sum(r['named'] for r in of)}, cannot tell {sum(r['word'] == 'cannot tell' for r in of)}, "
                f"apply {len(apply)} (worse than nominal {sum(r['true'] >= r['nominal'] for r in apply)}; the error "
                f"said for a wrong statement holds in {sum(warned)}) of {len(of)}; interval covers "
                f"{share(inside(r, 'true', 'said') for r in of)}; below half of nominal, and apply {halved}"
            )
    elif part == "named":
        says = {}
        for kind in cells.KINDS:
            of = [r for r in good if r["kind"] == kind]
            others, arm = (share(bool(r[k]) for r in of) for k in ("blamed", "effects"))
            told = f"named in {share(r['named'] for r in of)}, " if kind in EXPECTED else ""
            says[kind] = f"{told}something else of target or camera in {others}, of the arm in {arm}"
    elif part == "moved":
        changes = [c for r in good for c in r["changes"]]
        says = {"nothing": f"{sum(r['alarms'] for r in good)} false alarms in {sum(r['quiet'] for r in good)} images"}
        for name in sorted({c[0] for c in changes}):
            seen, among, alone = (share(c[k] for c in changes if c[0] == name) for k in (1, 2, 3))
            says[name] = f"within {FIVE} images {seen}, rightly named {among}, and nothing else {alone}"
    else:
        says = {key: good[0][key] for key in ("images", "with target", "corners", "detection_s", "fit_s", "word")}
    harness.table(part, ("", ""), list(says.items()))


def main() -> int:
    """Exit code: 0 where nothing failed; what is refused is counted."""
    parser = harness.parser(__doc__, seeds=None, names=SEEDS)
    parser.add_argument("--rendered", action="store_true", help="make images and find the corners in them")
    parser.add_argument("--faults", type=float, default=None, help="of every arm: 1 for 4 mm and 5 mrad a body")
    parser.add_argument("--measured-to-mm", type=float, default=1e3 * RULER_STD_M, help="of the sheet's rulers")
    parser.add_argument("--off", type=float, nargs="+", default=[-0.02, 0.02], help="of a sheet's size")
    parser.add_argument("--read", action="store_true", help="rulers stated at lengths that only who measured states")
    given = harness.parsed(parser)
    told = {"arms": ("rendered", "faults", "measured_to_mm"), "size": ("faults", "read")}
    rows = {"size": [{"off": off} for off in given.off], "named": [{"kind": kind} for kind in cells.KINDS]}
    tasks = [
        {"part": part, "seed": given.first + k, **more, **{name: getattr(given, name) for name in told.get(part, ())}}
        for part in given.names
        for k in range(SEEDS[part] if given.seeds is None else given.seeds)
        for more in rows.get(part, [{}])
    ]
    results = harness.each(one, tasks, given, lambda r: r.get("refused", r.get("word", "")))
    for part in given.names:
        own = [r for r in results if r["part"] == part and not r["failed"]]
        good = [r for r in own if "refused" not in r]
        if good:
            show(part, good)
        refused = [f"  {r['seed']}: {r['refused']}" for r in own if "refused" in r]
        harness.say(f"{part}: {len(refused)} refused", *refused)
    return int(bool(harness.failures(results)))


if __name__ == "__main__":
    sys.exit(main())

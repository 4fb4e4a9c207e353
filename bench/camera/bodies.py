"""Arms calibrated by fixed cameras and a body with twenty markers, glued on by hand: true errors, intervals, advice."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))

from camera.bodies import BODY_ON_TIP, BodyScene, Faults, body_scene, icosahedron, measured  # noqa: E402

from modcal_core.camera.at_tool import flange_in_tool  # noqa: E402
from modcal_core.camera.fit import CameraFit  # noqa: E402
from modcal_core.camera.solve import CameraSolution, solve_camera  # noqa: E402
from modcal_core.camera.tool_error import postures_in_view  # noqa: E402
from modcal_core.errors import ModcalError  # noqa: E402
from modcal_core.geometry import se3, so3  # noqa: E402
from modcal_core.geometry.so3 import Array  # noqa: E402

ARMS_MM = (0.2, 1.0, 5.0)  # by which each body of the arm is displaced; twice as many mrad
SIZE_KNOWN = 5e-4  # a tenth of a millimetre across 0.2 m
PERIODIC_RAD = 3e-4  # of joint 2 in every fourth cell
REFLECTOR = np.array([0.05, 0.03, 0.12, 1.0])  # of a tracker, in the frame of the arm's last link


def drawn(seed: int) -> tuple[BodyScene, dict[str, Any]]:
    """A cell, and what was drawn for it."""
    rng = np.random.default_rng([41, seed])
    arm = 1e-3 * ARMS_MM[seed % 3]
    corners, cameras = bool(seed // 3 % 2), 1 + seed // 2 % 2
    faults = Faults(
        arm_m=arm,
        arm_rad=2.0 * arm,
        place_m=float(rng.uniform(5e-4, 1e-3)),
        grow=float(rng.normal(0.0, SIZE_KNOWN)),
        shift_m=float(rng.uniform(1e-5, 5e-5)),
        joint_rad=float(rng.uniform(1e-5, 5e-5)),
        noise=float(rng.uniform(0.1, 0.3)),
        misread=float(rng.uniform(0.0, 0.02)),
        late=int(rng.integers(0, 4)),
        periodic=PERIODIC_RAD if seed % 4 == 3 else 0.0,
    )
    count = int(rng.integers(60, 200))
    most = 2 if seed % 8 == 5 else None  # few markers an image
    s = body_scene(seed, count, cameras, faults, corners, most, measured(icosahedron(), SIZE_KNOWN))
    said = {"arm": 1e3 * arm, "corners": corners, "cameras": cameras, "postures": count, "most": most}
    return s, said | {"periodic": faults.periodic > 0.0}


def in_camera(s: BodyScene, fit: CameraFit, point: Array, q: Array) -> tuple[float, float]:
    """RMS distance of the flange from where it is, in the frame of the first camera, and the camera put where that is
    least [mm].
    """
    T = fit.poses.at_postures(q).tool_at(fit.state.values)
    true = se3.inverse(s.cameras[0]) @ s.tip(q) @ BODY_ON_TIP @ s.true_body()
    a, b = se3.apply(T, point), se3.apply(true, point)
    U, _, Vt = np.linalg.svd((a - a.mean(0)).T @ (b - b.mean(0)))
    turned = (a - a.mean(0)) @ U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return _rms(a - b), _rms(turned - (b - b.mean(0)))


def by_tracker(s: BodyScene, fit: CameraFit, q: Array) -> float:
    """RMS distance of a reflector near the flange from where it is, the tracker's frame and the reflector's place on
    the tool refitted, as one does with readings [mm].
    """
    T = fit.poses.at_postures(q).tool_at(fit.state.values)
    true = (s.tip(q) @ REFLECTOR)[:, :3]
    p = (se3.inverse(fit.poses.model_at(fit.state.values).T_tip_tool) @ REFLECTOR)[:3]
    for _ in range(5):  # it is linear but for the frame's turn
        at = se3.apply(T, p)
        a, b = at.mean(0), true.mean(0)
        U, _, Vt = np.linalg.svd((true - b).T @ (at - a))
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        gap = true - (b + (at - a) @ R.T)
        turned = (at - a) @ R.T
        rows = np.concatenate([R @ T[:, :3, :3], np.broadcast_to(np.eye(3), (len(q), 3, 3)), -so3.hat(turned)], axis=2)
        step = np.linalg.lstsq(rows.reshape(-1, 9), gap.reshape(-1), rcond=None)[0]
        p = p + step[:3]
    left = gap.reshape(-1) - rows.reshape(-1, 9) @ step
    return _rms(left.reshape(-1, 3))


def _rms(gap: Array) -> float:
    return 1e3 * float(np.sqrt((gap**2).sum(axis=1).mean()))


def one_cell(seed: int) -> dict[str, Any]:
    """What came of a cell, and what is true of it."""
    out: dict[str, Any] = {"cell": seed}
    s, said = drawn(seed)
    out |= said
    first, *others = s.images
    began = time.process_time()
    try:
        r = solve_camera(
            *(s.chain, first.q, first.views, first.target, first.size, np.random.default_rng(seed)),
            further=others,
        )
    except ModcalError as error:
        return out | {"refused": str(error)}
    return out | _judged(s, r, time.process_time() - began)


def _judged(s: BodyScene, r: CameraSolution, seconds: float) -> dict[str, Any]:
    q, _ = postures_in_view(r.fit, np.random.default_rng(1))
    point = flange_in_tool(r.fit)
    true, true_alone = in_camera(s, r.fit, point, q)
    nominal, nominal_alone = in_camera(s, r.nominal, point, q)
    assert r.alone is not None
    return {
        "seconds": seconds,
        "word": r.decision.word,
        "because": r.decision.because[0],
        "true": true,
        "nominal": nominal,
        "said": [1e3 * x for x in r.in_view.interval],
        "true_alone": true_alone,
        "nominal_alone": nominal_alone,
        "said_alone": [1e3 * x for x in r.alone.interval],
        "tracker": by_tracker(s, r.fit, q),
        "tracker_nominal": by_tracker(s, r.nominal, q),
        "px": list(r.held_out_px),
        "effects": [c.effect.label for c in r.causes],
        "findings": [f"{f.family} {f.direction}" for f in r.findings],
        "out": len(r.left_out),
        "corners_out": r.corners_out,
    }


def show(cells: list[dict[str, Any]]) -> None:
    print("cell  arm  cam  what     n   in view true (95 %)          arm alone true (95 %)        by tracker    word")
    for c in cells:
        if "refused" in c:
            print(f"{c['cell']:4d}  {c['arm']:3.1f}  refused: {c['refused']}")
            continue
        what = ("corners" if c["corners"] else "middles") + ("" if c["most"] is None else f" {c['most']}")
        told = [
            f"{c[a]:5.2f} ({c[b][1]:.2f}-{c[b][2]:.2f})" for a, b in (("true", "said"), ("true_alone", "said_alone"))
        ]
        print(
            f"{c['cell']:4d}  {c['arm']:3.1f}  {c['cameras']}  {what:9s} {c['postures']:4d}  {told[0]:22s} nom "
            f"{c['nominal']:5.2f}  {told[1]:20s} nom {c['nominal_alone']:5.2f}  {c['tracker']:.2f} / "
            f"{c['tracker_nominal']:.2f}  {c['word']}  {', '.join(c['effects'])} {', '.join(c['findings'])}"
        )
    good = [c for c in cells if "refused" not in c]
    if not good:
        return

    def share(of: list[bool]) -> str:
        return f"{sum(of)} of {len(of)}"

    def inside(true: str, said: str) -> str:
        return share([c[said][1] <= c[true] <= c[said][2] for c in good])

    def below(true: str, said: str) -> str:
        return share([c[true] <= c[said][2] for c in good])

    print(f"in view, true error inside its interval: {inside('true', 'said')}, below it {below('true', 'said')}")
    print(f"arm alone: {inside('true_alone', 'said_alone')}, below {below('true_alone', 'said_alone')}")
    ratio = np.median([c["said_alone"][2] / c["true_alone"] for c in good])
    print(f"upper end over true error of the arm alone, median: {ratio:.2f}")
    apply = [c for c in good if c["word"] == "apply"]
    print(f"apply, and worse by the tracker: {share([c['tracker'] >= c['tracker_nominal'] for c in apply])}")
    halved = [c for c in good if c["tracker"] < 0.5 * c["tracker_nominal"]]
    print(f"error by the tracker below half of nominal, and apply said: {share([c in apply for c in halved])}")
    planted = [c for c in good if c["periodic"]]
    print(f"gear error of joint 2 found: {share([any('joint2' in e for e in c['effects']) for c in planted])}")
    clean = [c for c in good if not c["periodic"]]
    print(f"cells without one blamed for an effect: {share([bool(c['effects']) for c in clean])}")
    for arm in ARMS_MM:
        some = [c for c in good if c["arm"] == arm]
        if some:
            a, b = (np.median([c[k] for c in some]) for k in ("tracker_nominal", "tracker"))
            print(f"arm of {arm} mm a body, by the tracker, median: {a:.3f} mm nominal, {b:.3f} mm calibrated")
    print(f"seconds of processor, median: {np.median([c['seconds'] for c in good]):.1f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=12)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--json", type=Path, default=None, help="file that the cells are added to, one a line")
    chosen = parser.parse_args()
    cells = []
    for seed in range(chosen.first, chosen.first + chosen.cells):
        cells.append(one_cell(seed))
        if chosen.json is not None:
            with chosen.json.open("a") as file:
                file.write(json.dumps(cells[-1]) + "\n")
    show(cells)


if __name__ == "__main__":
    main()

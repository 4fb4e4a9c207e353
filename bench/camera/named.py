"""Late images, a rolling shutter, a print of another size, a bent sheet: how often each is named, and how often a clean
cell is blamed. The arm is known to half a millimetre, or a tracker saw fifteen points of the tool.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))

from camera.boards import BOARD, views  # noqa: E402
from camera.rolling import rolling_views  # noqa: E402
from camera.scenes import CameraScene, scene  # noqa: E402

from modcal_core.camera.beside import ReadingsBeside, beside  # noqa: E402
from modcal_core.camera.solve import CameraSolution, solve_camera  # noqa: E402
from modcal_core.errors import ModcalError  # noqa: E402
from modcal_core.geometry import se3  # noqa: E402
from modcal_core.measurements.samples import Samples  # noqa: E402

DELAY_S, READOUT_S, SCALE, BOW_M = 0.02, 0.015, 0.01, 5e-4
SPEED = 0.3  # rad/s of every joint, where the arm moves
KINDS = ("clean", "clean, moving", "delay", "line time", "scale", "bow")
EXPECTED = {"delay": ("clock", "velocity"), "line time": ("clock", "line")}
EXPECTED |= {"scale": ("target", "constant"), "bow": ("target", "constant")}
DIRECTION = {"scale": "size", "bow": "normal"}


def cell(seed: int, kind: str) -> dict[str, Any]:
    """What was named in a cell."""
    rng = np.random.default_rng([26, seed, KINDS.index(kind)])
    tracked = bool(seed // 2 % 2)  # else the arm's accuracy is stated
    size = 1.0 if tracked else 0.1  # bodies off by up to 3 mm, or by 0.3: half a millimetre at the tool
    on_tip = bool(seed % 2)
    s = scene(2000 + seed, on_tip, count=25, length_std=1.5e-3 * size, angle_std=2e-3 * size, board=BOARD)
    velocity = SPEED * rng.choice([-1.0, 1.0], s.q.shape)
    points = BOARD.points.copy()
    side = float(rng.choice([-1.0, 1.0]))
    if kind == "scale":
        points = points * (1.0 + side * SCALE)
    if kind == "bow":
        middle = 0.5 * (points.max(0) + points.min(0))
        x, y = (points - middle)[:, :2].T
        mode = (x * x, x * y, y * y)[rng.integers(3)]
        points[:, 2] = side * BOW_M * mode / np.abs(mode).max()
    moving = kind in ("clean, moving", "delay", "line time")
    if moving:
        delay, readout = side * DELAY_S * (kind == "delay"), READOUT_S * (kind == "line time")
        s = rolling_views(s, velocity, delay, readout, rng)
        velocity = velocity[[int(v.name.partition(".")[0]) for v in s.views]]
    else:
        s = replace(s, views=views(rng, se3.inverse(s.T) if on_tip else s.T, printed=points))
    out: dict[str, Any] = {"cell": seed, "kind": kind, "known by": "tracker" if tracked else "stated"}
    try:
        r = solve_camera(
            *(s.chain, s.q, s.views, BOARD, s.lens.size, np.random.default_rng(seed)),
            velocity=velocity if moving else None,
            arm_m=None if tracked else 5e-4,
            beside=_points(s, rng) if tracked else None,
        )
    except ModcalError as error:
        return out | {"refused": str(error)}
    return out | _judged(r, kind)


def _points(s: CameraScene, rng: np.random.Generator) -> ReadingsBeside:
    """Fifteen points of a ball on the tool, read to 50 µm by a tracker that stands anywhere."""
    q = rng.uniform(s.q.min(0), s.q.max(0), (15, s.chain.n))
    T = se3.exp([1.5, -0.4, 0.3, 0.2, 0.1, 2.0]) @ s.truth(q)
    seen = se3.apply(T, [0.03, -0.05, 0.12]) + 5e-5 * rng.standard_normal((len(q), 3))
    return beside(s.chain, Samples.from_arrays(q, points=seen, names=s.chain.names))


def _judged(r: CameraSolution, kind: str) -> dict[str, Any]:
    wanted = EXPECTED.get(kind)
    right = [(f.family, f.driver) == wanted and f.direction == DIRECTION.get(kind, "all") for f in r.findings]
    return {
        "named": any(right),
        "blamed": [f.sentence for f, good in zip(r.findings, right, strict=True) if not good],
        "effects": [c.effect.label for c in r.causes],
        "because": list(r.decision.because),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=10)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--json", type=Path, default=None, help="file that the cells are added to, one a line")
    chosen = parser.parse_args()
    cells = []
    for seed in range(chosen.first, chosen.first + chosen.cells):
        for kind in chosen.kinds:
            cells.append(cell(seed, kind))
            if chosen.json is not None:
                with chosen.json.open("a") as file:
                    file.write(json.dumps(cells[-1]) + "\n")
    for kind in chosen.kinds:
        of = [c for c in cells if c["kind"] == kind]
        good = [c for c in of if "refused" not in c]
        others = sum(bool(c["blamed"]) for c in good)
        arms = sum(bool(c["effects"]) for c in good)
        named = f"named in {sum(c['named'] for c in good)} of {len(of)}, " if kind in EXPECTED else ""
        print(f"{kind}: {named}something else of target or camera in {others}, of the arm in {arms} of {len(good)}")


if __name__ == "__main__":
    main()

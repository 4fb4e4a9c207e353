"""A camera or target that is moved by 2 mm or 0.2°, a joint that slips by 0.2°, or nothing, while the robot works:
named within five images, and how often for nothing.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))

from camera.boards import BOARD, views  # noqa: E402
from camera.scenes import CameraScene, scene  # noqa: E402

from modcal_core.camera.solve import solve_camera  # noqa: E402
from modcal_core.camera.target_file import RULER_STD_M, scale_of_rulers  # noqa: E402
from modcal_core.camera.views import BoardView  # noqa: E402
from modcal_core.camera.watching import CameraWatch  # noqa: E402
from modcal_core.geometry import se3  # noqa: E402
from modcal_core.geometry.so3 import Array  # noqa: E402

MEASURED = replace(BOARD, scale=scale_of_rulers((0.21, 0.15), (0.21, 0.15), "rulers", RULER_STD_M))
SHIFT_M, TURN_RAD = 2e-3, np.radians(0.2)
QUIET, BEFORE, AFTER, FIVE, TWICE = (
    300,
    8,
    8,
    5,
    2,
)  # images without a change; before and after one; that may pass; each
FAULTS = ((1e-3, 1.5e-3), (4e-3, 5e-3))  # m and rad that bodies are displaced by
NOTHING = np.zeros(6)


def images(
    s: CameraScene, rng: np.random.Generator, count: int, world: Array = NOTHING, tip: Array = NOTHING,
    slipped: tuple[int, float] = (0, 0.0),
) -> list[tuple[Array, BoardView]]:  # fmt: skip
    """(joints, view) of images near those of the calibration, the halves moved by these twists about where they are."""
    q = s.q[rng.integers(len(s.q), size=count)] + 0.05 * rng.standard_normal((count, s.chain.n))
    true = q + 5e-5 * rng.standard_normal(q.shape)
    true[:, slipped[0]] += slipped[1]
    T = s.truth(true)
    middle = se3.transform(np.eye(3), T[:, :3, 3].mean(axis=0))
    T = middle @ se3.exp(world) @ se3.inverse(middle) @ T @ se3.exp(tip)
    seen = views(rng, se3.inverse(T) if s.on_tip else T, board=s.board, lens=s.lens)
    return [(p, replace(v, stamp=float(i))) for i, (p, v) in enumerate(zip(q, seen, strict=True)) if len(v) >= 8]


def _along(rng: np.random.Generator, size: float) -> Array:
    direction = rng.normal(size=3)
    return np.asarray(size * direction / np.linalg.norm(direction))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=8)
    parser.add_argument("--first", type=int, default=0)
    chosen = parser.parse_args()
    quiet = alarms = 0
    found: dict[str, list[int]] = {}
    for seed in range(chosen.first, chosen.first + chosen.cells):
        on_tip = bool(seed % 2)
        length, angle = FAULTS[seed // 2 % 2]
        s = scene(9000 + seed, on_tip, count=25, length_std=length, angle_std=angle, board=MEASURED)
        rng = np.random.default_rng(seed)
        fit = solve_camera(s.chain, s.q, s.views, s.board, s.lens.size, rng, look_for_effects=False).fit
        watch = CameraWatch(fit, s.board)
        said = [watch.image(v, q) is not None for q, v in images(s, rng, QUIET)]
        quiet += len(said)
        alarms += sum(now and not before for before, now in zip([False, *said], said, strict=False))
        for _ in range(TWICE):
            joint = int(rng.integers(1, 6))
            shift, turn = np.r_[_along(rng, SHIFT_M), 0.0, 0.0, 0.0], np.r_[0.0, 0.0, 0.0, _along(rng, TURN_RAD)]
            in_world, on_arm = ("target", "camera") if on_tip else ("camera", "target")
            cases = (
                (f"{in_world} in the world, 2 mm", in_world, images(s, rng, AFTER, world=shift)),
                (f"{in_world} in the world, 0.2°", in_world, images(s, rng, AFTER, world=turn)),
                (f"{on_arm} on the arm, 2 mm", on_arm, images(s, rng, AFTER, tip=shift)),
                (f"{on_arm} on the arm, 0.2°", on_arm, images(s, rng, AFTER, tip=turn)),
                ("joint, 0.2°", f"joint {s.chain.names[joint]}", images(s, rng, AFTER, slipped=(joint, TURN_RAD))),
            )
            for name, what, after in cases:
                watch = CameraWatch(fit, s.board)
                for q, v in images(s, rng, BEFORE):
                    watch.image(v, q)
                names = [moved.what for q, v in after[:FIVE] if (moved := watch.image(v, q)) is not None]
                row = found.setdefault(name, [0, 0, 0, 0])
                row[0] += 1
                row[1] += bool(names)
                row[2] += bool(names) and what in names[-1].split(" or ")
                row[3] += bool(names) and names[-1] == what
    print(f"nothing moved: {alarms} false alarms in {quiet} images of {chosen.cells} cells")
    for name, (count, seen, among, alone) in sorted(found.items()):
        print(f"{name}: within {FIVE} images {seen} of {count}, rightly named {among}, and nothing else {alone}")


if __name__ == "__main__":
    main()

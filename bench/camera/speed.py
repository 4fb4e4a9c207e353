"""Thirty images of 1280 × 720 with a ChArUco board of 7 × 5 squares: processor of detection, of fit and diagnosis."""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))

from camera.boards import BOARD, LENS  # noqa: E402
from camera.render import render  # noqa: E402
from camera.scenes import scene  # noqa: E402

from modcal_core.camera.solve import solve_camera  # noqa: E402
from modcal_core.camera.target_file import RULER_STD_M, scale_of_rulers  # noqa: E402
from modcal_core.geometry import se3  # noqa: E402
from modcal_nodes.vision.detect import detect  # noqa: E402

MEASURED = replace(BOARD, scale=scale_of_rulers((0.21, 0.15), (0.21, 0.15), "rulers", RULER_STD_M))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--images", type=int, default=30)
    chosen = parser.parse_args()
    s = scene(5, True, count=chosen.images, board=MEASURED)
    rng = np.random.default_rng(0)
    pictures = [render(T, LENS, BOARD, rng) for T in se3.inverse(s.T)]
    detect(pictures[0], MEASURED, "warm")
    began, clock = time.process_time(), time.perf_counter()
    views = [detect(picture, MEASURED, f"{i}.png").view for i, picture in enumerate(pictures)]
    detected, seen = time.process_time() - began, time.perf_counter() - clock
    keep = [i for i, view in enumerate(views) if view is not None]
    began = time.process_time()
    r = solve_camera(s.chain, s.q[keep], [v for v in views if v is not None], MEASURED, LENS.size, rng)
    solved = time.process_time() - began
    n = len(pictures)
    print(
        f"{n} images, {len(keep)} with the target, {int(r.fit.table.weight.sum())} corners; advice: {r.decision.word}"
    )
    print(f"detection: {detected:.2f} s of processor, {n / detected:.0f} images/s ({n / seen:.0f} by the clock)")
    print(f"fit, effects and verdict: {solved:.2f} s of processor; all together {detected + solved:.2f} s")


if __name__ == "__main__":
    main()

"""A sheet 2 % off what is stated of its rulers, on arms some millimetres off a body: is it named, left open, or passed?

Who has not measured states the nominal lengths; with ``--read`` other lengths are stated, as who has measured does.
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

from camera.boards import BOARD  # noqa: E402
from camera.scenes import scene  # noqa: E402

from modcal_core.camera.solve import solve_camera  # noqa: E402
from modcal_core.camera.target_file import scale_of_rulers  # noqa: E402
from modcal_core.camera.tool_error import postures_in_view  # noqa: E402
from modcal_core.geometry import se3  # noqa: E402

RULERS = (0.21, 0.15)
_OFF_NOMINAL = 0.004  # of rulers that somebody did read: who does not measure states no such length


def cell(seed: int, off: float, size: float, read: bool) -> dict[str, Any]:
    """What was said of a cell whose sheet is larger than stated by ``off``.

    size: of the arm's faults, 1 for 4 mm. read: the rulers were stated at another length than the nominal one.
    """
    stated = 1.0 + _OFF_NOMINAL * read
    measured = scale_of_rulers(RULERS, (stated * RULERS[0], stated * RULERS[1]), "rulers")
    s = scene(
        7000 + seed,
        on_tip=bool(seed % 2),
        count=25,
        length_std=4e-3 * size,
        angle_std=5e-3 * size,
        board=replace(BOARD, scale=measured),
        printed=stated * (1.0 + off) * BOARD.points,
    )
    r = solve_camera(s.chain, s.q, s.views, s.board, s.lens.size, np.random.default_rng(3))
    q, _ = postures_in_view(r.fit, np.random.default_rng(1))

    def error(fit: Any) -> float:
        model = fit.poses.model_at(fit.state.values)
        tip = se3.inverse(model.T_tip_tool)[:3, 3]
        gap = se3.apply(model.predict(q), tip) - se3.apply(s.truth(q), tip)
        return 1e3 * float(np.sqrt((gap**2).sum(1).mean()))

    rests = r.rests_on
    return {
        "cell": seed,
        "off": off,
        "word": r.decision.word,
        "named": any("off its stated size" in said for said in r.decision.problems),
        "said": [1e3 * x for x in r.in_view.interval],
        "true": error(r.fit),
        "nominal": error(r.nominal),
        "images_percent": None if rests is None else 100.0 * rests.images_std,
        "mm_per_percent": None if rests is None else 10.0 * rests.per_unit_m,
        "if_wrong": None if rests is None else 1e3 * rests.if_wrong_m,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, default=10)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--off", type=float, nargs="+", default=[-0.02, 0.02])
    parser.add_argument("--faults", type=float, default=1.0, help="of every arm: 1 for 4 mm and 5 mrad a body")
    parser.add_argument(
        "--read", action="store_true", help="the rulers are stated at lengths that nobody states without a measurement"
    )
    parser.add_argument("--json", type=Path, default=None, help="file that the cells are added to, one a line")
    chosen = parser.parse_args()
    cells = []
    for seed in range(chosen.first, chosen.first + chosen.cells):
        for off in chosen.off:
            cells.append(cell(seed, off, chosen.faults, chosen.read))
            if chosen.json is not None:
                with chosen.json.open("a") as file:
                    file.write(json.dumps(cells[-1]) + "\n")
    for off in chosen.off:
        of = [c for c in cells if c["off"] == off]
        apply = [c for c in of if c["word"] == "apply"]
        covered = [c for c in of if c["said"][1] <= c["true"] <= c["said"][2]]
        halved = [c for c in of if c["true"] < 0.5 * c["nominal"]]
        warned = [c for c in apply if c["if_wrong"] is not None and c["true"] <= c["if_wrong"]]
        print(
            f"{100.0 * off:+.0f} %: named {sum(c['named'] for c in of)}, cannot tell "
            f"{sum(c['word'] == 'cannot tell' for c in of)}, apply {len(apply)} (worse than nominal "
            f"{sum(c['true'] >= c['nominal'] for c in apply)}; the error said for a wrong statement holds in "
            f"{len(warned)}) of {len(of)}; error below half of nominal in {len(halved)}, apply said in "
            f"{sum(c['word'] == 'apply' for c in halved)}; interval covers {len(covered)}"
        )


if __name__ == "__main__":
    main()

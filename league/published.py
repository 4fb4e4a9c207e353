"""Peers' own figures again, by their own definitions, from the data that they published.

python -m league.published FOLDER writes what comes out beside the published figures of `published.json`.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from league import excerpts
from league.arm import Arm, Array, pose, quaternion_rotation, rotation, rotation_vector

HERE = Path(__file__).resolve().parent
TURNS, OFFSET = 100.0, 0.005  # weight of an angle beside metres, expected size of an offset [m, rad], as published


def positioner(folder: Path, offsets: bool, turned: bool = False) -> float:
    """Mean position error of all poses of the two-axis positioner [mm], from industrial_calibration's problem.

    Fitted are camera and target from the published guesses, and the four DH offsets of the first axis if asked for. The
    camera's guess is not turned, and there the derivative by its rotation vector is taken to be zero: it stays so.
    """
    table = excerpts.positioner(folder)
    arm, R = Arm.from_urdf(table.urdf, table.tip), quaternion_rotation(table.reading[:, 3:])
    text = (folder / "industrial_calibration" / "positioner_initial_guesses.yaml").read_text()
    values = {name: float(v) for name, v in re.findall(r"(\w+): (\S+)", text.partition("target_mount")[0])}
    camera = _pose(values)
    target = _pose({name: float(v) for name, v in re.findall(r"(\w+): (\S+)", text.partition("target_mount")[2])})

    def seen(x: Array) -> Array:
        d, turn, r, alpha = x[12:] if offsets else np.zeros(4)
        first = pose(rotation(np.array([0.0, 0.0, turn])), np.array([0.0, 0.0, d]))
        first = first @ pose(rotation(np.array([alpha, 0.0, 0.0])), np.array([r, 0.0, 0.0]))
        steps = arm.steps.copy()
        steps[1] = first @ steps[1]
        tips = arm.frames(table.q, steps)[:, -1]
        mounts = [pose(rotation(x[k + 3 : k + 6]), x[k : k + 3]) for k in (0, 6)]
        return np.linalg.inv(camera @ mounts[0]) @ tips @ target @ mounts[1]

    def residual(x: Array) -> Array:
        T = seen(x * free)
        off = R @ np.swapaxes(T[:, :3, :3], 1, 2)
        moved = table.reading[:, :3] - np.einsum("nij,nj->ni", off, T[:, :3, 3])
        return np.r_[moved.ravel(), TURNS * rotation_vector(off).ravel(), x[12:] / OFFSET]

    free = np.ones(16 if offsets else 12)
    free[3:6] = turned
    x = free * least_squares(residual, np.zeros(len(free)), max_nfev=500).x
    return float(1e3 * np.linalg.norm(seen(x)[:, :3, 3] - table.reading[:, :3], axis=1).mean())


def _pose(values: dict[str, float]) -> Array:
    turn = quaternion_rotation(np.array([values[name] for name in ("qx", "qy", "qz", "qw")]))
    return pose(turn, np.array([values[name] for name in "xyz"]))


AGAIN = {
    "industrial_calibration, nominal": lambda folder: positioner(folder, offsets=False),
    "industrial_calibration, DH": lambda folder: positioner(folder, offsets=True),
}


def main(folder: Path) -> None:
    """Write and print what comes out."""
    file = HERE / "published.json"
    rows = json.loads(file.read_text())
    for row in (row for row in rows if row["method"] in AGAIN):
        row["here_mm"] = round(AGAIN[row["method"]](folder), 5)
        print(f"{row['method']}: {row['here_mm']} mm, published {row['mean_mm']} mm")
    file.write_text("[\n" + ",\n".join(f" {json.dumps(row, ensure_ascii=False)}" for row in rows) + "\n]\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))

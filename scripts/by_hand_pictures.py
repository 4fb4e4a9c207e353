"""The pictures of docs/howto/measure_by_hand.md, from a measurement done as the page says.

.venv/bin/python scripts/by_hand_pictures.py [FOLDER]     # writes docs/howto/by_hand_*.svg; after `make build`

A technician is played: the command is given as on the page, each row of next.csv is driven to in MuJoCo, where every
body of the arm stands a little beside its place, and the reading is written into the row as a German spreadsheet writes
it, with semicolons and decimal commas. One station is not seen. FOLDER: keep the session there.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "bench"), str(ROOT / "tests")]
import conftest  # noqa: E402, F401 (finds the install tree)
import matplotlib  # noqa: E402
import numpy as np  # noqa: E402
from matplotlib.axes import Axes  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402
from sites import REPEAT, Cell, Stations  # noqa: E402

from modcal_core.calibration.store import Calibration  # noqa: E402
from modcal_core.robot import Robot  # noqa: E402
from modcal_core.robots.kinematics import chain_forward, frames, link_frames  # noqa: E402
from modcal_nodes.cli.main import run  # noqa: E402

FOLDER = ROOT / "docs" / "howto"
URDF = ROOT / "examples" / "robots" / "ur10.urdf"
SITE = ROOT / "examples" / "planning" / "hall.yaml"
GOAL = 0.2  # mm
NOISE = 2e-5  # m, per axis
TARGET, TRACKER = (0.05, 0.0, 0.1), (2.5, 0.3, 0.6)  # m, in the tip and in the base, as hall.yaml has them
ARM, SEEN, PROOF = "#4a4a4a", "#1a5fb4", "#a15c00"
POSTURES = 400
FEW = 5  # rows of the table that are shown


class Hall:
    """The arm as it is, the reflector on it and the tracker beside it."""

    def __init__(self) -> None:
        self._rng = np.random.default_rng(7)
        self._cell = Cell("ur10", self._rng)
        self._cell.tool = np.array(TARGET), Rotation.identity()
        self._cell.tracker = np.array(TRACKER), Rotation.from_euler("z", 180.0, degrees=True)

    def reading(self, q: np.ndarray) -> np.ndarray:
        """What the tracker says [mm] while the arm stands at these joints [rad]."""
        stands = q + REPEAT * self._rng.standard_normal(len(q))
        return self.exact(stands[None])[0] + 1e3 * NOISE * self._rng.standard_normal(3)

    def exact(self, q: np.ndarray) -> np.ndarray:
        """Where the reflector is in the tracker's frame at postures (m, n), (m, 3) [mm]."""
        return 1e3 * self._cell.poses(Stations(q, np.zeros(len(q)), np.ones_like(q))).p


def measured(folder: Path, hall: Hall) -> tuple[list[dict[str, Any]], list[list[str]]]:
    """What the command said each time, and the first table as it was filled in."""
    said: list[dict[str, Any]] = []
    first: list[list[str]] = []
    command = ["measure", str(URDF), "--goal-mm", str(GOAL), "--by-hand", str(folder), "--site", str(SITE), "--json"]
    while True:
        out = io.StringIO()
        began = time.process_time()
        with contextlib.redirect_stdout(out):
            code = run(command)
        said.append({**json.loads(out.getvalue()), "code": code, "seconds": time.process_time() - began})
        table = folder / "next.csv"
        if said[-1]["ending"] is not None:
            return said, first
        rows = list(csv.reader(io.StringIO(table.read_text(encoding="utf-8"))))
        joints = [k for k, name in enumerate(rows[0]) if name.endswith("_joint_deg")]
        for row in rows[1:]:
            reading = hall.reading(np.radians([float(row[k]) for k in joints]))
            row[rows[0].index("x_mm") : rows[0].index("z_mm") + 1] = [f"{v:.3f}" for v in reading]
        if not first:
            rows[2][rows[0].index("x_mm") :] = ["", "", "", "unseen"]
            first = rows
        german = "\n".join(";".join(cell.replace(".", ",") for cell in row) for row in rows)
        table.write_text(german + "\n", encoding="utf-8")


def spreadsheet(rows: list[list[str]]) -> Figure:
    """The table as a spreadsheet shows it, with its first readings."""
    short = [name.replace("_joint_deg", "\n[deg]").replace("_mm", "\n[mm]").replace("_", " ") for name in rows[0]]
    cells = [[cell.replace(".", ",") for cell in row] for row in rows[1 : FEW + 1]]
    figure = Figure(figsize=(10.0, 0.38 * (len(cells) + 2)), facecolor="white", layout="constrained")
    axes = figure.subplots()
    axes.axis("off")
    table = axes.table(cells, colLabels=short, loc="center", cellLoc="right")
    table.auto_set_font_size(False)
    table.set_fontsize(8.5)
    table.auto_set_column_width(list(range(len(short))))
    table.scale(1.0, 1.35)
    read = [rows[0].index(name) for name in ("x_mm", "y_mm", "z_mm", "note")]
    for (row, column), cell in table.get_celld().items():
        cell.set_edgecolor("#c8c8c8")
        if row == 0:
            cell.set_height(1.7 * cell.get_height())
            cell.set_facecolor("#eeeeee")
        elif column in read:
            cell.set_facecolor("#e7effa")
            cell.get_text().set_color(SEEN)
    return figure


def postures(rows: list[list[str]]) -> Figure:
    """The first stations from the side: the arm, its reflector, and the line of sight of the tracker."""
    joints = [k for k, name in enumerate(rows[0]) if name.endswith("_joint_deg")]
    q = np.radians([[float(row[k]) for k in joints] for row in rows[1:4]])
    chain = Robot.from_urdf(URDF).mechanism
    figure = Figure(figsize=(10.0, 2.0), facecolor="white", layout="constrained")
    for axes, one, row in zip(figure.subplots(1, 3), q, rows[1:4], strict=True):
        T = np.concatenate([link_frames(chain, frames(chain, one[None]))[0], chain_forward(chain, one[None])])
        _side(axes, T, row[rows[0].index("note")] == "unseen")
        axes.set_title(f"station {row[0]} ({row[1]})", fontsize=10)
    return figure


def _side(axes: Axes, T: np.ndarray, unseen: bool) -> None:
    points = np.concatenate([[[0.0, 0.0, 0.0]], T[:, :3, 3]])
    ball = T[-1, :3, :3] @ np.array(TARGET) + T[-1, :3, 3]
    axes.plot(points[:, 0], points[:, 2], color=ARM, lw=4.0, marker="o", ms=5.0, solid_capstyle="round")
    axes.plot(*np.stack([points[-1], ball])[:, [0, 2]].T, color=ARM, lw=1.5)
    axes.plot(
        *np.stack([ball, np.array(TRACKER)])[:, [0, 2]].T, color=SEEN, lw=0.9, ls="--" if not unseen else (0, (1, 6))
    )
    axes.plot(ball[0], ball[2], "o", color=SEEN, ms=7.0)
    axes.plot(TRACKER[0], TRACKER[2], "s", color=SEEN, ms=10.0)
    axes.annotate(
        "tracker", (TRACKER[0], TRACKER[2]), xytext=(0, -14), textcoords="offset points", ha="center", fontsize=9
    )
    if unseen:
        axes.annotate("unseen", ball[[0, 2]], xytext=(8, 6), textcoords="offset points", fontsize=9, color=PROOF)
    axes.axhline(0.0, color="#bbbbbb", lw=1.0)
    axes.set_xlim(-1.0, 2.9)
    axes.set_ylim(-0.1, 1.6)
    axes.set_aspect("equal")
    axes.axis("off")


def result(folder: Path, said: dict[str, Any]) -> Figure:
    """The error at the stations of the proof before and after, with what is proven."""
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    nominal, proof = report["error_mm"]["nominal"]["rms"], said["proof"]
    figure = Figure(figsize=(8.0, 1.9), facecolor="white", layout="constrained")
    axes = figure.subplots()
    axes.barh(1, nominal, height=0.5, color="#b3261e", alpha=0.6)
    axes.annotate(f"{nominal:.2f} mm", (nominal, 1), xytext=(5, 0), textcoords="offset points", va="center", fontsize=9)
    axes.barh(0, proof["at_most_mm"], height=0.5, color=SEEN, alpha=0.3)
    axes.barh(0, proof["rms_mm"], height=0.5, color=SEEN)
    words = f"{proof['rms_mm']:.3f} mm, at most {proof['at_most_mm']:.3f} mm with 95 % confidence"
    axes.annotate(words, (GOAL, 0), xytext=(5, 0), textcoords="offset points", va="center", fontsize=9)
    for k, name in enumerate(("corrected arm", "nominal arm")):
        axes.annotate(name, (0.0, k), xytext=(-6, 0), textcoords="offset points", ha="right", va="center", fontsize=10)
    axes.axvline(GOAL, color="#2e7d32", lw=1.2, ls="--")
    axes.annotate(
        f"goal {GOAL:g} mm", (GOAL, 1.42), xytext=(4, 0), textcoords="offset points", color="#2e7d32", fontsize=9
    )
    axes.set_yticks([])
    axes.set_ylim(-0.5, 1.75)
    axes.set_xlim(left=0.0)
    axes.set_xlabel(f"error at {said['stations']['proof']} random stations that no fit has seen, RMS [mm]", fontsize=9)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    return figure


def truth(folder: Path, hall: Hall) -> float:
    """RMS distance [mm] between the written model and MuJoCo's arm, at random postures of the stations' ranges."""
    calibration = Calibration.load(folder)
    low, high = calibration.seen
    q = np.random.default_rng(1).uniform(low, high, (POSTURES, len(low)))
    return float(np.sqrt(np.mean(np.sum((1e3 * calibration.predict(q)[:, :3, 3] - hall.exact(q)) ** 2, axis=1))))


def main() -> None:
    """Measure and draw."""
    with tempfile.TemporaryDirectory() as scratch:
        folder, hall = Path(sys.argv[1] if len(sys.argv) > 1 else scratch) / "my_arm", Hall()
        said, rows = measured(folder, hall)
        for s in said:
            next_ = s["next"] or {}
            print(s["stations"], next_.get("why", "ended"), f"{s['seconds']:.1f} s, exit code {s['code']}")
        print(said[-1]["sentence"])
        print(f"against MuJoCo at {POSTURES} random postures: {truth(folder, hall):.3f} mm RMS")
        figures = (("table", spreadsheet(rows)), ("postures", postures(rows)), ("result", result(folder, said[-1])))
    with matplotlib.rc_context({"svg.hashsalt": "modcal", "svg.fonttype": "none"}):
        for name, figure in figures:
            figure.savefig(FOLDER / f"by_hand_{name}.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()

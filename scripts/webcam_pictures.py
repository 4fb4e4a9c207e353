"""The pictures of docs/howto/webcam.md: the two mountings, images as the detector sees them, and a result.

.venv/bin/python scripts/webcam_pictures.py      # writes docs/howto/webcam_*; after `make build`
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
import conftest  # noqa: E402, F401 (finds the install tree)
import cv2  # noqa: E402
import matplotlib  # noqa: E402
import numpy as np  # noqa: E402
from camera.boards import BOARD, facing  # noqa: E402
from camera.fits import problem  # noqa: E402
from camera.render import render  # noqa: E402
from camera.scenes import BOARD_IN_WORLD, BOARD_ON_TIP, CAMERA_IN_WORLD, CAMERA_ON_TIP, HOME, panda, scene  # noqa: E402
from matplotlib.axes import Axes  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

from modcal_core.camera.lens import Lens  # noqa: E402
from modcal_core.camera.solve import CameraSolution, solve_camera  # noqa: E402
from modcal_core.camera.target_file import RULER_STD_M, scale_of_rulers  # noqa: E402
from modcal_core.geometry import se3  # noqa: E402
from modcal_core.geometry.so3 import Array  # noqa: E402
from modcal_core.robots.kinematics import chain_forward, frames, link_frames  # noqa: E402
from modcal_nodes.vision.coaching import Coach  # noqa: E402
from modcal_nodes.vision.detection import annotated, detect  # noqa: E402

FOLDER = ROOT / "docs" / "howto"
VGA = Lens(np.array([520.0, 522.0, 322.0, 238.0, -0.1, 0.05, 5e-4, -3e-4, 0.0]), (640, 480))
ARM, SEEN, SHEET = "#4a4a4a", "#1a5fb4", "#a15c00"
ACROSS = 3  # images side by side
WIDTH = 320  # px of each
LETTERS = 38  # of a line below one


def mountings() -> Figure:
    """The arm from the side, with the camera on its tip, and with the board on it."""
    figure = Figure(figsize=(8.0, 3.4), facecolor="white", layout="constrained")
    both = figure.subplots(1, 2)
    T = panda_frames()
    _setup(both[0], T, T[-1] @ CAMERA_ON_TIP, BOARD_IN_WORLD, "camera on the tip, board on the table")
    _setup(both[1], T, CAMERA_IN_WORLD, T[-1] @ BOARD_ON_TIP, "camera on a tripod, board on the tip")
    return figure


def panda_frames() -> Array:
    """Where the arm's joints and its tip are, (8, 4, 4)."""
    chain = panda()
    return np.concatenate([link_frames(chain, frames(chain, HOME[None]))[0], chain_forward(chain, HOME[None])])


def _setup(axes: Axes, T: Array, camera: Array, board: Array, title: str) -> None:
    turn = 0.9  # rad about the vertical; seen from slightly above
    flat = np.array([[np.cos(turn), np.sin(turn), 0.0], [-0.3 * np.sin(turn), 0.3 * np.cos(turn), 0.95]])

    def drawn(points: Array, colour: str, width: float, fill: bool = False) -> None:
        x, y = flat @ np.asarray(points).T
        if fill:
            axes.fill(x, y, facecolor=colour, alpha=0.3, edgecolor=colour, lw=width)
        else:
            axes.plot(x, y, color=colour, lw=width, solid_capstyle="round", marker="o", ms=width + 1.5)

    drawn(np.concatenate([[[0.0, 0.0, 0.0]], T[:, :3, 3]]), ARM, 4.0)
    w, h = BOARD.size
    corners = se3.apply(board, np.array([[0, 0, 0], [w, 0, 0], [w, h, 0], [0, h, 0]], dtype=float))
    drawn(corners, SHEET, 1.5, fill=True)
    eye = camera[:3, 3]
    held = camera[:3, 3] if np.linalg.norm(camera[:3, 3] - T[-1, :3, 3]) < 0.2 else corners.mean(axis=0)
    drawn(np.stack([T[-1, :3, 3], held]), ARM, 2.0)
    for corner in corners:
        x, y = flat @ np.stack([eye, corner]).T
        axes.plot(x, y, color=SEEN, lw=0.8, ls=":")
    ends = se3.apply(camera, 0.12 * np.array([[-0.6, -0.45, 1], [0.6, -0.45, 1], [0.6, 0.45, 1], [-0.6, 0.45, 1]]))
    for k in range(4):
        drawn(np.stack([eye, ends[k], ends[(k + 1) % 4]]), SEEN, 1.2, fill=True)
    axes.set_title(title, fontsize=10)
    axes.set_aspect("equal")
    axes.axis("off")


def images() -> np.ndarray:
    """Images as board_detector sees them: three good ones with what the coach says, and three that cannot be used."""
    rng = np.random.default_rng(5)
    coach = Coach(BOARD, VGA.size, VGA)
    out = []
    for T in facing(rng, ACROSS, tilt=0.9, near=0.2, far=0.32):
        grey = render(T, VGA, BOARD, rng)
        view = detect(grey, BOARD, "").view
        coach.image(view)
        out.append(_captioned(annotated(grey, view, ""), coach.image(view), view is not None))
    T = facing(rng, 1, tilt=0.5)[0]
    for grey in (
        render(T, VGA, BOARD, rng, blur=3.2),
        np.ascontiguousarray(render(T, VGA, BOARD, rng)[:, ::-1]),
        render(se3.transform(np.eye(3), [-0.1, -0.07, 4.0]), VGA, BOARD, rng),
    ):
        found = detect(grey, BOARD, "")
        out.append(_captioned(annotated(grey, found.view, ""), found.reason, found.view is not None))
    rows = [np.hstack(out[k : k + ACROSS]) for k in range(0, len(out), ACROSS)]
    return np.asarray(np.vstack(rows))


def _captioned(image: np.ndarray, said: str, good: bool) -> np.ndarray:
    """The image made small, what is said of it below in letters that can be read."""
    out = cv2.resize(image, (WIDTH, WIDTH * 3 // 4), interpolation=cv2.INTER_AREA)
    bar = np.full((44, WIDTH, 3), (60, 140, 60) if good else (50, 50, 190), np.uint8)
    words, lines = said.encode("ascii", "replace").decode().split(), [""]
    for word in words:
        longer = f"{lines[-1]} {word}".strip()
        lines = [*lines[:-1], longer] if len(longer) <= LETTERS else [*lines, word]
    for k, line in enumerate(lines[:2]):
        cv2.putText(bar, line, (6, 17 + 18 * k), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
    return np.asarray(np.vstack([out, bar]))


def solved() -> CameraSolution:
    """A calibration of an arm that is a centimetre off, from 25 images."""
    board_measured = scale_of_rulers((0.21, 0.15), (0.21, 0.15), "rulers", RULER_STD_M)
    s = scene(1, True, count=25, board=replace(BOARD, scale=board_measured), lens=VGA)
    return solve_camera(problem(s), np.random.default_rng(0))


def result(solution: CameraSolution) -> Figure:
    """The error at the tool before and after, with its interval."""
    figure = Figure(figsize=(8.0, 1.7), facecolor="white", layout="constrained")
    axes = figure.subplots()
    rows = (("nominal arm", solution.claim.in_view.nominal_interval, "#b3261e"),)
    rows += (("calibrated arm", solution.claim.in_view.interval, "#1a5fb4"),)
    for k, (name, (middle, low, high), colour) in enumerate(reversed(rows)):
        axes.barh(k, 1e3 * (high - low), left=1e3 * low, height=0.5, color=colour, alpha=0.35)
        axes.plot([1e3 * middle] * 2, [k - 0.3, k + 0.3], color=colour, lw=2.5)
        axes.annotate(f"{1e3 * middle:.2f} mm", (1e3 * middle, k + 0.36), color=colour, ha="center", fontsize=9)
        axes.annotate(name, (0.0, k), xytext=(-6, 0), textcoords="offset points", ha="right", va="center", fontsize=10)
    axes.set_yticks([])
    axes.set_ylim(-0.6, 1.75)
    axes.set_xlim(left=0.0)
    axes.set_xlabel("error at the tool where the board is in view, RMS [mm]; bar: 95 % interval", fontsize=9)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    return figure


def main() -> None:
    """Draw all of them."""
    with matplotlib.rc_context({"svg.hashsalt": "modcal", "svg.fonttype": "none"}):
        mountings().savefig(FOLDER / "webcam_mountings.svg", metadata={"Date": None})
        result(solved()).savefig(FOLDER / "webcam_result.svg", metadata={"Date": None})
    cv2.imwrite(str(FOLDER / "webcam_images.jpg"), images(), [cv2.IMWRITE_JPEG_QUALITY, 80])


if __name__ == "__main__":
    main()

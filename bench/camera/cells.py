"""Cells with cameras drawn by seed: a Panda of MuJoCo whose bodies are displaced; corners by OpenCV, or rendered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from camera.boards import BOARD, views
from camera.bodies import BodyScene, Faults, body_scene, icosahedron, measured
from camera.render import render
from camera.rolling import rolling_views
from camera.scenes import CameraScene, scene

from modcal_core.camera.bundle import BoardView
from modcal_core.camera.equations import ReadingsBeside, beside
from modcal_core.camera.lens import Lens
from modcal_core.camera.target_file import RULER_STD_M, scale_of_rulers
from modcal_core.geometry import Array, se3
from modcal_core.measurements.samples import Samples
from modcal_nodes.vision import detect

RULERS = (0.21, 0.15)  # m, as on the sheet of this board
BOW_M, SIZES = 3e-4, ((640, 480), (1280, 720))
RAYS = 4  # a pixel along either side: with two, edges wander by a fifteenth of a pixel, which no camera's do
MEASURED = replace(BOARD, scale=scale_of_rulers(RULERS, RULERS, "rulers", RULER_STD_M))
KINDS = ("clean", "clean, moving", "delay", "line time", "scale", "bow")
DELAY_S, READOUT_S, SCALE, SHEET_BOW_M, SPEED = 0.02, 0.015, 0.01, 5e-4, 0.3  # the last: rad/s of every joint
ARMS_MM = (0.2, 1.0, 5.0)  # by which each body of an arm with markers is displaced; twice as many mrad
SIZE_KNOWN, PERIODIC_RAD = 5e-4, 3e-4  # of the block; of joint 2 in every fourth cell


def arm(seed: int, rendered: bool, faults: float | None = None, ruler_m: float = RULER_STD_M) -> CameraScene:
    """Everything that differs from one to the next: lens, sheet, mounting, arm, noise.

    faults: of the arm, 1 for 4 mm and 5 mrad a body; None: drawn too. ruler_m: to what the sheet was measured.
    """
    rng = np.random.default_rng([25, seed])
    size = np.array(SIZES[seed % 2])
    f = rng.uniform(0.7, 1.1) * size[0]
    values = [f, f * rng.normal(1.0, 0.002), *(0.5 * s + rng.normal(0.0, 0.01 * s) for s in size)]
    values += [rng.uniform(-0.2, 0.05), rng.uniform(-0.1, 0.1), *rng.normal(0.0, 5e-4, 2), rng.normal(0.0, 0.02)]
    lens = Lens(np.array(values), SIZES[seed % 2])
    true = 1.0 + rng.normal(0.0, 0.01) + rng.normal(0.0, 0.002, 2)
    read = true * RULERS + rng.normal(0.0, ruler_m, 2)
    board = replace(BOARD, scale=scale_of_rulers(RULERS, (float(read[0]), float(read[1])), "rulers", ruler_m))
    points = BOARD.points * np.r_[true, 1.0]
    middle = 0.5 * (points.max(0) + points.min(0))
    x, y = ((points - middle)[:, :2] / (0.5 * np.linalg.norm(np.ptp(points, axis=0)))).T
    bow = rng.normal(0.0, BOW_M, 3)
    points[:, 2] = bow[0] * x * x + bow[1] * x * y + bow[2] * y * y
    drawn = rng.choice([0.0, 0.1, 0.3, 1.0])
    much, count = drawn if faults is None else faults, int(rng.integers(20, 31))
    repeat, noise = float(rng.uniform(2e-5, 1e-4)), float(rng.uniform(0.05, 0.2))
    how = {"lens": lens, "board": board, "printed": points, "compliance": float(rng.choice([0.0, 1e-5]))}
    s = scene(1000 + seed, seed % 4 < 2, count, 4e-3 * much, 5e-3 * much, repeat, noise, **how)
    if not rendered:
        return s
    found = []
    for i, pose in enumerate(se3.inverse(s.T) if s.on_tip else s.T):
        blur = float(rng.uniform(0.6, 1.3))
        found.append(detect(render(pose, lens, BOARD, rng, blur, 3.0, RAYS, (true[0], true[1]), bow), board, f"{i}"))
    keep = [i for i, one in enumerate(found) if one.view is not None]
    return replace(s, q=s.q[keep], T=s.T[keep], views=[one.view for one in found if one.view is not None])


def sheet(seed: int, off: float, size: float, read: bool) -> CameraScene:
    """A sheet larger than stated by ``off``. read: its rulers were stated at other lengths than the nominal."""
    stated = 1.0 + 0.004 * read  # who does not measure states no such length
    board = replace(BOARD, scale=scale_of_rulers(RULERS, (stated * RULERS[0], stated * RULERS[1]), "rulers"))
    printed = stated * (1.0 + off) * BOARD.points
    return scene(7000 + seed, bool(seed % 2), 25, 4e-3 * size, 5e-3 * size, board=board, printed=printed)


def faulty(seed: int, kind: str) -> tuple[CameraScene, dict[str, object]]:
    """Late images, a rolling shutter, a print of another size or a bent sheet; and what the solution is told.

    The arm is known to half a millimetre, or a tracker saw fifteen points of the tool.
    """
    rng = np.random.default_rng([26, seed, KINDS.index(kind)])
    tracked = bool(seed // 2 % 2)  # else the arm's accuracy is stated
    size = 1.0 if tracked else 0.1  # bodies off by up to 3 mm, or by 0.3: half a millimetre at the tool
    s = scene(2000 + seed, bool(seed % 2), count=25, length_std=1.5e-3 * size, angle_std=2e-3 * size, board=BOARD)
    velocity, points = SPEED * rng.choice([-1.0, 1.0], s.q.shape), BOARD.points.copy()
    side = float(rng.choice([-1.0, 1.0]))
    if kind == "scale":
        points = points * (1.0 + side * SCALE)
    if kind == "bow":
        x, y = (points - 0.5 * (points.max(0) + points.min(0)))[:, :2].T
        mode = (x * x, x * y, y * y)[rng.integers(3)]
        points[:, 2] = side * SHEET_BOW_M * mode / np.abs(mode).max()
    moving = kind in ("clean, moving", "delay", "line time")
    if moving:
        s = rolling_views(s, velocity, side * DELAY_S * (kind == "delay"), READOUT_S * (kind == "line time"), rng)
        velocity = velocity[[int(v.name.partition(".")[0]) for v in s.views]]
    else:
        s = replace(s, views=views(rng, se3.inverse(s.T) if s.on_tip else s.T, printed=points))
    told = {"arm_m": None if tracked else 5e-4, "beside": _tracked(s, rng) if tracked else None}
    return s, {"velocity": velocity if moving else None, **told}


def _tracked(s: CameraScene, rng: np.random.Generator) -> ReadingsBeside:
    """Fifteen points of a ball on the tool, read to 50 µm by a tracker that stands anywhere."""
    q = rng.uniform(s.q.min(0), s.q.max(0), (15, s.chain.n))
    T = se3.exp([1.5, -0.4, 0.3, 0.2, 0.1, 2.0]) @ s.truth(q)
    seen = se3.apply(T, [0.03, -0.05, 0.12]) + 5e-5 * rng.standard_normal((len(q), 3))
    return beside(s.chain, Samples.from_arrays(q, points=seen, names=s.chain.names))


def images(
    s: CameraScene, rng: np.random.Generator, count: int, joint: int = 0, slip: float = 0.0, **moved: Array
) -> list[tuple[Array, BoardView]]:
    """(joints, view) of images near those of the calibration; moved: twists of ``world`` and ``tip`` where they are."""
    world, tip = (moved.get(half, np.zeros(6)) for half in ("world", "tip"))
    q = s.q[rng.integers(len(s.q), size=count)] + 0.05 * rng.standard_normal((count, s.chain.n))
    true = q + 5e-5 * rng.standard_normal(q.shape)
    true[:, joint] += slip
    T = s.truth(true)
    middle = se3.transform(np.eye(3), T[:, :3, 3].mean(axis=0))
    T = middle @ se3.exp(world) @ se3.inverse(middle) @ T @ se3.exp(tip)
    seen = views(rng, se3.inverse(T) if s.on_tip else T, board=s.board, lens=s.lens)
    return [(p, replace(v, stamp=float(i))) for i, (p, v) in enumerate(zip(q, seen, strict=True)) if len(v) >= 8]


def body(seed: int) -> tuple[BodyScene, dict[str, object]]:
    """One or two fixed cameras and a body with twenty markers, glued on by hand; and what was drawn for it."""
    rng = np.random.default_rng([41, seed])
    mm, corners, cameras = ARMS_MM[seed % 3], bool(seed // 3 % 2), 1 + seed // 2 % 2
    place, grow = float(rng.uniform(5e-4, 1e-3)), float(rng.normal(0.0, SIZE_KNOWN))
    shift, joint = (float(rng.uniform(1e-5, 5e-5)) for _ in range(2))
    noise, misread, late = float(rng.uniform(0.1, 0.3)), float(rng.uniform(0.0, 0.02)), int(rng.integers(0, 4))
    arm = {"arm_m": 1e-3 * mm, "arm_rad": 2e-3 * mm, "periodic": PERIODIC_RAD if seed % 4 == 3 else 0.0}
    marks = {"place_m": place, "grow": grow, "noise": noise, "misread": misread, "late": late}
    count, most = int(rng.integers(60, 200)), 2 if seed % 8 == 5 else None  # few markers an image
    faults = Faults(shift_m=shift, joint_rad=joint, **arm, **marks)
    s = body_scene(seed, count, cameras, faults, corners, most, measured(icosahedron(), SIZE_KNOWN))
    what = {"arm": mm, "corners": corners, "cameras": cameras, "postures": count, "most": most}
    return s, {**what, "periodic": seed % 4 == 3}
